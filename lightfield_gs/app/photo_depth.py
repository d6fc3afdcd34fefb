"""The depth map of a photo: of a file, beside the photo, inside its file, or estimated by a network."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.photo_camera import camera_of_photo
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_MODEL
from lightfield_gs.photo.side_by_side import is_rgbd_name

if TYPE_CHECKING:
    import numpy as np

    from lightfield_gs.io.images import Picture
    from lightfield_gs.photo.depth import DepthMap, DepthNumbers
    from lightfield_gs.photo.load import Photo

AUTO = Path("auto")  # in place of the file of --depth
# How a depth map beside its photo is taken when nothing else is said: bright is near, as Looking Glass has it
_BESIDE_KIND, _BESIDE_LIMITS = "disparity", (1.0, 1.6)


def is_estimated(args: argparse.Namespace) -> bool:
    """Whether the depth of the photo is estimated by a network."""
    return args.depth == AUTO


def depth_file(args: argparse.Namespace) -> Path | None:
    """The file of --depth, where it is one."""
    return None if is_estimated(args) else args.depth


def depth_model(args: argparse.Namespace) -> str:
    """The network of --depth auto."""
    return args.depth_model or DEPTH_MODEL


def depth_by_network(args: argparse.Namespace, photo: Photo, device: str) -> DepthMap:
    """The depth map of --depth auto. Raises InputError."""
    from lightfield_gs.photo.depth_network import estimated_depth

    return estimated_depth(
        photo.floats(),
        depth_model(args),
        "cuda" if device == "cuda" else "cpu",
        kind=args.depth_kind,
        limits=args.depth_range,
        say=lambda words: print(words, flush=True),
    )


def has_depth(args: argparse.Namespace) -> bool:
    """Whether the photo comes with its depths, in a file, beside it in the picture or inside its file, or they are to
    be estimated."""
    return args.depth is not None or args.rgbd is not None or is_rgbd_name(args.input) or is_depth_inside(args)


def is_depth_inside(args: argparse.Namespace) -> bool:
    """Whether the depths of a photo are those inside its file: nothing gives others, or asks for an object alone."""
    others = ("depth", "rgbd", "mask", "checkpoint", "detail", "detail_budget")
    if is_rgbd_name(args.input) or getattr(args, "remove_background", False):
        return False
    if any(getattr(args, name, None) is not None for name in others):
        return False
    from lightfield_gs.photo.embedded_depth import find_embedded_depth

    return find_embedded_depth(args.input) is not None


def depth_of_file(args: argparse.Namespace, photo: Photo) -> DepthMap:
    """The map of --depth, at the photo's size. Raises InputError."""
    from lightfield_gs.photo.depth import read_numbers

    numbers = read_numbers(args.depth)
    turn = _turn_with(args, photo, args.map_orientation)
    depth = _mapped(args, args.depth, numbers, args.depth_kind, args.depth_range, photo.pixels.shape[:2], turn)
    return _fitted(
        str(args.depth), replace(depth, description=f"depth by {args.depth.name}: {depth.description}"), photo
    )


def depth_beside(args: argparse.Namespace, picture: Picture, side: str) -> DepthMap:
    """The map in the half `side` of the picture, as Looking Glass has it where nothing else is said. Raises
    InputError."""
    from lightfield_gs.photo.depth import nearness
    from lightfield_gs.photo.side_by_side import read_depth_half

    numbers = read_depth_half(args.input, picture.pixels, side)
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
    description = f"depth by its {side} half: {depth.description}{near}" + (
        f" (assumed; {', '.join(assumed)})" if assumed else ""
    )
    return replace(depth, description=description)


def depth_within(args: argparse.Namespace, photo: Photo) -> DepthMap:
    """The map inside the photo's file, as its format has it where nothing else is said. Raises InputError."""
    from lightfield_gs.photo.depth import nearness
    from lightfield_gs.photo.embedded_depth import find_embedded_depth

    inside = find_embedded_depth(args.input)
    assert inside is not None
    limits = _limits_or(args, (inside.near, inside.far) if inside.near and inside.far else _BESIDE_LIMITS)
    kind = args.depth_kind
    if kind is None and args.depth_scale is None:
        kind = "disparity" if inside.is_inverse else "distance"
        if inside.is_inverse and limits is not None:
            limits = limits[::-1]  # dark is near in both formats
    turn = _turn_with(args, photo, args.map_orientation or "stored")
    depth = _mapped(args, args.input, inside.numbers(args.input), kind, limits, photo.pixels.shape[:2], turn)
    description = f"depth inside it ({inside.name}): {depth.description}"
    if args.depth_kind is None and limits is not None:
        near = nearness(str(kind), limits)
        description += "" if near in description else f", {near}"
        if args.depth_range is None:
            description += " by its format (--depth-range FAR,NEAR where it is not)"
            description += "" if inside.near else ", near and far assumed (--depth-range)"
    return _fitted(f"{args.input}: the depth map inside it", replace(depth, description=description), photo)


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
    from lightfield_gs.photo.load import turn_with_photo

    return lambda numbers: turn_with_photo(
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
    from lightfield_gs.photo.joint_upsampling import resize_to_photo
    from lightfield_gs.photo.load import has_same_shape

    shape, size = depth.z.shape, photo.pixels.shape[:2]
    if shape == size:
        return depth
    if not has_same_shape(shape, size):
        raise InputError(
            f"{name}: expected a depth map of the photo's size {size[1]} x {size[0]}, or of its shape, got {shape[1]} "
            f"x {shape[0]}; crop one of them, so that both show the same"
        )
    way = "along the photo's edges" if math.prod(shape) <= math.prod(size) else "pixel by pixel"
    description = f"{depth.description}, of {shape[1]} x {shape[0]}, fitted to the photo {way}"
    return replace(depth, z=resize_to_photo(depth.z, photo.floats()), description=description)
