"""Options of a scene: how its file is read, what is made of a photo, and how it is drawn."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from lightfield_gs.base.options import (
    DEPTH_INVALID,
    DEPTH_KINDS,
    DEPTH_MODEL,
    DEPTH_PARTS,
    DETAILS,
    FITS,
    MAP_ORIENTATIONS,
)
from lightfield_gs.commands.options.parser import background, numbers, within

Add = Callable[..., argparse.Action]
_time = within(-1e6, 1e6)
_depth_range = numbers(2)
_pixel_aspect = within(0.1, 10)
_intrinsics = numbers(4)
_filter_views = within(0, 65536, "views")


def add_scene(
    add: Add,
    cutting: str,
    mask: str = "cut-out of a photo, of its size: bright or opaque on the object",
    of_mask: str = "IMAGE",
) -> None:
    """Add the options of a scene.

    Args:
        add: adds an option.
        cutting: help of --remove-background.
        mask: help of --mask.
        of_mask: placeholder of --mask.
    """
    add("--mask", type=Path, metavar=of_mask, help=mask)
    add("--remove-background", action="store_true", help=cutting)
    add_depth(add)
    add_detail(add)
    add("--checkpoint", type=Path, metavar="FILE", help="weights of the network, .safetensors (default: those inside)")
    add_reading(add)


def add_reading(add: Add) -> None:
    """Add the options of how a file of Gaussians is read."""
    add(
        "--skip-invalid",
        action="store_true",
        help="leave out Gaussians whose values have no meaning (not finite, a rotation of zeros), and say how many",
    )
    add(
        "--time",
        type=_time,
        metavar="T",
        help="the time at which Gaussians that move (Spacetime Gaussians) are drawn, mostly 0..1 of their film "
        "(default: in its middle, which is said)",
    )


def add_depth(add: Add) -> None:
    """Add the options of a photo's depth map, and of the meaning of its numbers."""
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
        type=_depth_range,
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
        type=_pixel_aspect,
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
        type=_intrinsics,
        metavar="FX,FY,CX,CY",
        help="in place of --fov: focal lengths and principal "
        "point of the photo, in its pixels, from the outer corner of the first",
    )
    add_fit(add)


def add_depth_model(add: Add) -> None:
    add(
        "--depth-model",
        metavar="NAME|FOLDER",
        help="the network of --depth auto: its name on huggingface.co, or a folder with its files (default "
        f"{DEPTH_MODEL})",
    )


def add_fit(add: Add) -> None:
    add(
        "--fit",
        choices=FITS,
        help="how a photo with depths fills a panel of another shape: cover crops it, contain shows all of it and "
        "makes up the rest of its own texture (default: cover, unless more than a third would be cropped)",
    )


def add_detail(add: Add) -> None:
    """Add the options of how finely a photo is laid over the network's Gaussians."""
    add(
        "--detail",
        type=lambda text: int(text) if text.isdecimal() else text,
        choices=(*DETAILS, "none"),
        help="resolution of the photo on the object: 1, 2 or 4 times the network's, none for the network's own soft "
        "colours, or auto, what a view of the panel can show (default auto)",
    )
    add("--detail-budget", type=int, metavar="N", help="Gaussians at most for --detail auto (default 1500000)")


def add_antialiased(add: Add) -> None:
    add(
        "--antialiased",
        action=argparse.BooleanOptionalAction,
        help="for scenes trained with anti-aliasing (Mip-Splatting, gsplat's antialiased mode), which look too bright "
        "and too thick without: what a pixel blurs becomes fainter by as much (default: as the file says that "
        "it was trained, else without)",
    )


def add_view_filter(add: Add) -> None:
    add(
        "--view-filter",
        type=_filter_views,
        default=0.0,
        metavar="VIEWS",
        help="anti-aliasing between views, of a rig: each sub-pixel's picture is averaged over camera positions this "
        "many views wide, so that what lies far before or behind the panel is blurred in place of seen double; 0: off, "
        "1: the width of a view (default 0)",
    )


def add_background(add: Add) -> None:
    add(
        "--background",
        type=background,
        metavar="R,G,B",
        help="0..1 each (default: what the file says that lightfield-gs fitted it before, else 1,1,1)",
    )
