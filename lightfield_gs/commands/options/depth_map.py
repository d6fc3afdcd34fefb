"""The options of a photo's depth map, and the map that they and its file make."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.options import DEPTH_INVALID, DEPTH_KINDS, DEPTH_PARTS, MAP_ORIENTATIONS
from lightfield_gs.commands.options.estimated import add_depth_model
from lightfield_gs.commands.options.placing import add_fit
from lightfield_gs.commands.options.values import numbers
from lightfield_gs.photo.side_by_side import halves, is_named_so

if TYPE_CHECKING:
    from lightfield_gs.io.images import Picture
    from lightfield_gs.photo.depth import DepthMap
    from lightfield_gs.photo.depth_files import DepthNumbers
    from lightfield_gs.photo.load import Photo

# How a depth map beside its photo is taken when nothing else is said: bright is near, as Looking Glass has it
_BESIDE_KIND, _BESIDE_LIMITS = "disparity", (1.0, 1.6)


def add_depth(add: Callable[..., argparse.Action]) -> None:
    """The depth map of a photo, and what its numbers mean."""
    add(
        "--depth",
        type=Path,
        metavar="FILE|auto",
        help="depth map of the photo, of its size: the whole scene is shown, "
        "without the network; a grey .png (8 or 16 bits), .exr or .tif, or a .npy or .npz of numbers [H,W]; auto: a "
        "network of transformers estimates it (pip install 'lightfield-gs[depth]'; downloads 99 MB once)",
    )
    add_depth_model(add)
    add(
        "--depth-kind",
        choices=DEPTH_KINDS,
        help="what its numbers are: distance, along the camera's "
        "axis (default), or disparity, 1 / distance, as most networks give it (bright is near)",
    )
    add(
        "--depth-range",
        type=numbers(2),
        metavar="NEAR,FAR",
        help="distances, in any unit, at the ends of the file's "
        "full scale (0..255, 0..65535, floats 0..1); their ratio sets how deep the scene looks",
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
        help="what infinite distances and the disparity 0 are: far away "
        "(default), or holes, as NaN and the distance 0 always are",
    )
    add(
        "--rgbd",
        choices=DEPTH_PARTS,
        help="in place of --depth: the half of the photo that is its depth map (found by "
        "itself for names like photo_rgbd.png); bright is near and --depth-range 1,1.6 when not said",
    )
    add(
        "--map-orientation",
        choices=MAP_ORIENTATIONS,
        help="of --mask and --depth for a photo that its Exif "
        "orientation turns: as the photo's file has its pixels, or as it is seen (default: by their size)",
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
    """Whether the photo comes with its depths, in a file or beside it in the picture, or they are to be estimated."""
    return args.depth is not None or args.rgbd is not None or is_named_so(args.input)


def depth_of_file(args: argparse.Namespace, photo: Photo) -> DepthMap:
    from lightfield_gs.photo.depth import depth_map
    from lightfield_gs.photo.depth_files import read_numbers
    from lightfield_gs.photo.orientation import turned_with_photo

    def turn(numbers: DepthNumbers):
        return turned_with_photo(
            str(args.depth),
            numbers.values,
            numbers.orientation,
            photo.pixels.shape[:2],
            photo.orientation,
            args.map_orientation,
        )

    depth = depth_map(
        args.depth,
        read_numbers(args.depth),
        args.depth_kind,
        scale=args.depth_scale,
        limits=args.depth_range,
        invalid=args.depth_invalid or "far",
        turn=turn,
    )
    return replace(depth, said=f"depth by {args.depth.name}: {depth.said}")


def depth_beside(args: argparse.Namespace, picture: Picture, side: str) -> DepthMap:
    from lightfield_gs.photo.depth import depth_map
    from lightfield_gs.photo.depth_files import grey_numbers

    numbers = grey_numbers(f"{args.input}: its {side} half", halves(args.input, picture.pixels, side)[1])
    limits = args.depth_range
    if limits is None and args.depth_scale is None:
        limits = _BESIDE_LIMITS
    kind = args.depth_kind or (_BESIDE_KIND if limits is not None else None)
    depth = depth_map(
        args.input, numbers, kind, scale=args.depth_scale, limits=limits, invalid=args.depth_invalid or "far"
    )
    assumed = [
        name
        for name, value in (
            ("--depth-kind", args.depth_kind),
            ("--depth-range", args.depth_range),
            ("--rgbd", args.rgbd),
        )
        if value is None and args.depth_scale is None
    ]
    said = f"depth by its {side} half: {depth.said}" + (f" (assumed; {', '.join(assumed)})" if assumed else "")
    return replace(depth, said=said)
