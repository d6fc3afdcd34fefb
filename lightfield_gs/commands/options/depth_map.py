"""The options of a photo's depth map, and the map that they and its file make."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_INVALID, DEPTH_KINDS, DEPTH_PARTS, MAP_ORIENTATIONS
from lightfield_gs.commands.options.estimated import add_depth_model
from lightfield_gs.commands.options.photo_camera import camera_of_photo
from lightfield_gs.commands.options.placing import add_fit
from lightfield_gs.commands.options.values import numbers, within
from lightfield_gs.photo.side_by_side import is_named_so

if TYPE_CHECKING:
    import numpy as np

    from lightfield_gs.io.images import Picture
    from lightfield_gs.photo.depth import DepthMap, DepthNumbers
    from lightfield_gs.photo.load import Photo

# How a depth map beside its photo is taken when nothing else is said: bright is near, as Looking Glass has it
_BESIDE_KIND, _BESIDE_LIMITS = "disparity", (1.0, 1.6)


def add_depth(add: Callable[..., argparse.Action]) -> None:
    """The depth map of a photo, and what its numbers mean."""
    add(
        "--depth",
        type=Path,
        metavar="FILE|auto",
        help="depth map of the photo, of its shape: the whole scene is shown, "
        "without the network; a grey .png (8 or 16 bits) or .tif, an .exr with a depth channel, or a .npy or .npz of "
        "numbers [H,W]; auto: a "
        "network of transformers estimates it (pip install 'lightfield-gs[depth]'; downloads 99 MB once)",
    )
    add_depth_model(add)
    add(
        "--depth-kind",
        choices=DEPTH_KINDS,
        help="what its numbers are: distance, along the camera's "
        "axis (default), ray, distance along each pixel's ray, as some renderers and scanners give it, or disparity, "
        "1 / distance, as most networks give it (bright is near)",
    )
    add(
        "--depth-range",
        type=numbers(2),
        metavar="NEAR,FAR",
        help="distances, in any unit, at the ends of the file's "
        "full scale (0..255, 0..65535, floats 0..1); their ratio sets how deep the scene looks; FAR,NEAR where the "
        "ends are the other way round: 1.6,1 for distances of which bright is near",
    )
    add(
        "--depth-scale",
        type=float,
        metavar="S",
        help="in place of a range: distance = S * number, or S / number of a "
        "disparity; 0.001 for millimetres to metres (default for floats: 1); the distance 0 is no measurement",
    )
    add(
        "--depth-invalid",
        choices=DEPTH_INVALID,
        help="what infinite distances, those that stand for the sky (1e10, 65504, 65535) and the disparity 0 are: far "
        "away (default), or holes, as NaN and the distance 0 always are",
    )
    add(
        "--rgbd",
        choices=DEPTH_PARTS,
        help="in place of --depth: the half of the photo that is its depth map (found by itself for names like "
        "photo_rgbd.png, and so is a map inside a telephone's .jpg); bright is near and --depth-range 1,1.6 when not "
        "said",
    )
    add(
        "--map-orientation",
        choices=MAP_ORIENTATIONS,
        help="of --mask and --depth for a photo that its Exif "
        "orientation turns: as the photo's file has its pixels, or as it is seen (default: by their size)",
    )
    add(
        "--pixel-aspect",
        type=within(0.1, 10),
        metavar="A",
        help="width by height of a pixel of a photo with depths: 2 where photo and map are squeezed to half their "
        "width to lie side by side, 0.5 where to half their height (default 1)",
    )
    add(
        "--fov",
        type=float,
        metavar="DEG",
        help="angle that the photo's longer side takes, degrees (default 60, "
        "unless the depth map's .npz has a focal length)",
    )
    add(
        "--intrinsics",
        type=numbers(4),
        metavar="FX,FY,CX,CY",
        help="in place of --fov: focal lengths and principal "
        "point of the photo, in its pixels, from the outer corner of the first",
    )
    add_fit(add)


def has_depth(args: argparse.Namespace) -> bool:
    """Whether the photo comes with its depths, in a file, beside it in the picture or inside its file, or they are to
    be estimated."""
    return args.depth is not None or args.rgbd is not None or is_named_so(args.input) or is_depth_inside(args)


def is_depth_inside(args: argparse.Namespace) -> bool:
    """Whether the depths of a photo are those inside its file: nothing gives others, or asks for an object alone."""
    others = ("depth", "rgbd", "mask", "checkpoint", "detail", "detail_budget")
    if is_named_so(args.input) or getattr(args, "remove_background", False):
        return False
    if any(getattr(args, name, None) is not None for name in others):
        return False
    from lightfield_gs.photo.embedded_depth import depth_inside

    return depth_inside(args.input) is not None


def depth_of_file(args: argparse.Namespace, photo: Photo) -> DepthMap:
    """The map of --depth, at the photo's size. Raises InputError."""
    from lightfield_gs.photo.depth import read_numbers

    numbers = read_numbers(args.depth)
    turn = _turn_with(args, photo, args.map_orientation)
    depth = _mapped(args, args.depth, numbers, args.depth_kind, args.depth_range, photo.pixels.shape[:2], turn)
    return _fitted(str(args.depth), replace(depth, said=f"depth by {args.depth.name}: {depth.said}"), photo)


def depth_beside(args: argparse.Namespace, picture: Picture, side: str) -> DepthMap:
    """The map in the half `side` of the picture, as Looking Glass has it where nothing else is said. Raises
    InputError."""
    from lightfield_gs.photo.depth import nearness
    from lightfield_gs.photo.side_by_side import beside_numbers

    numbers = beside_numbers(args.input, picture.pixels, side)
    limits = _limits_or(args, _BESIDE_LIMITS)
    # A range that is given the other way round says by itself that bright is near
    is_plain = limits is not None and limits[0] <= limits[1]
    kind = args.depth_kind or (_BESIDE_KIND if is_plain else None)
    depth = _mapped(args, args.input, numbers, kind, limits, numbers.values.shape[:2])
    assumed = [
        name
        for name, is_assumed in (
            ("--depth-kind", args.depth_kind is None and is_plain),
            ("--depth-range", args.depth_range is None),
            ("--rgbd", args.rgbd is None),
        )
        if is_assumed and args.depth_scale is None
    ]
    near = f", {nearness(kind, limits)}" if kind is not None and is_plain else ""
    said = f"depth by its {side} half: {depth.said}{near}" + (f" (assumed; {', '.join(assumed)})" if assumed else "")
    return replace(depth, said=said)


def depth_within(args: argparse.Namespace, photo: Photo) -> DepthMap:
    """The map inside the photo's file, as its format has it where nothing else is said. Raises InputError."""
    from lightfield_gs.photo.depth import nearness
    from lightfield_gs.photo.embedded_depth import depth_inside

    inside = depth_inside(args.input)
    assert inside is not None
    limits = _limits_or(args, (inside.near, inside.far) if inside.near and inside.far else _BESIDE_LIMITS)
    kind = args.depth_kind
    if kind is None and args.depth_scale is None:
        kind = "disparity" if inside.is_inverse else "distance"
        if inside.is_inverse and limits is not None:
            limits = limits[::-1]  # dark is near in both formats
    turn = _turn_with(args, photo, args.map_orientation or "stored")
    depth = _mapped(args, args.input, inside.numbers(args.input), kind, limits, photo.pixels.shape[:2], turn)
    said = f"depth inside it ({inside.name}): {depth.said}"
    if args.depth_kind is None and limits is not None:
        near = nearness(str(kind), limits)
        said += "" if near in said else f", {near}"
        if args.depth_range is None:
            said += " by its format (--depth-range FAR,NEAR where it is not)"
            said += "" if inside.near else ", near and far assumed (--depth-range)"
    return _fitted(f"{args.input}: the depth map inside it", replace(depth, said=said), photo)


def _limits_or(args: argparse.Namespace, own: tuple[float, float]) -> tuple[float, float] | None:
    """The limits that options say, or a map's own where they say neither limits nor a scale."""
    return own if args.depth_range is None and args.depth_scale is None else args.depth_range


def _mapped(
    args: argparse.Namespace,
    path: Path,
    numbers: DepthNumbers,
    kind: str | None,
    limits: tuple[float, float] | None,
    size: tuple[int, int],
    turn: Callable[[DepthNumbers], tuple[np.ndarray, bool]] | None = None,
) -> DepthMap:
    """The map of these numbers, by the options; size: height and width of the photo. Raises InputError."""
    from lightfield_gs.photo.depth import depth_map

    return depth_map(
        path,
        numbers,
        kind,
        scale=args.depth_scale,
        limits=limits,
        invalid=args.depth_invalid or "far",
        turn=turn,
        rays=_rays_of(args, size, numbers.focal_px),
    )


def _turn_with(
    args: argparse.Namespace, photo: Photo, choice: str | None
) -> Callable[[DepthNumbers], tuple[np.ndarray, bool]]:
    """What turns numbers as upright as the photo is; choice: of --map-orientation."""
    from lightfield_gs.photo.load import turned_with_photo

    return lambda numbers: turned_with_photo(
        str(args.depth),
        numbers.values,
        numbers.orientation,
        photo.pixels.shape[:2],
        photo.orientation,
        choice,
        any_size=True,
    )


def _rays_of(
    args: argparse.Namespace, size: tuple[int, int], focal_px: float | None
) -> Callable[[tuple[int, int]], np.ndarray]:
    """The lengths of the rays of a map of a photo of this height and width; focal_px: of the depth's file."""
    from lightfield_gs.photo.depth import ray_lengths
    from lightfield_gs.photo.rgbd import known_camera

    def rays(shape: tuple[int, int]) -> np.ndarray:
        focal, centre, _, _ = camera_of_photo(args, *size, focal_px)
        return ray_lengths(shape, size, *known_camera(focal, centre, *size))

    return rays


def _fitted(name: str, depth: DepthMap, photo: Photo) -> DepthMap:
    """A map at the photo's size; of another size it has to have the photo's shape. Raises InputError."""
    from lightfield_gs.photo.joint_upsampling import at_size_of_photo
    from lightfield_gs.photo.load import is_alike

    shape, size = depth.z.shape, photo.pixels.shape[:2]
    if shape == size:
        return depth
    if not is_alike(shape, size):
        raise InputError(
            f"{name}: expected a depth map of the photo's size {size[1]} x {size[0]}, or of its shape, got {shape[1]} "
            f"x {shape[0]}; crop one of them, so that both show the same"
        )
    way = "along the photo's edges" if math.prod(shape) <= math.prod(size) else "pixel by pixel"
    said = f"{depth.said}, of {shape[1]} x {shape[0]}, fitted to the photo {way}"
    return replace(depth, z=at_size_of_photo(depth.z, photo.floats()), said=said)
