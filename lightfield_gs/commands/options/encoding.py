"""Options of `lightfield-gs encode`, which `batch` has too."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from lightfield_gs.base.options import COMPRESSIONS, DEVICES, METHODS, QUALITY_NAMES, VIEWS
from lightfield_gs.commands.options.cameras import add_camera, add_depth_report, add_look
from lightfield_gs.commands.options.panel import add_panel
from lightfield_gs.commands.options.parser import byte_size, threads
from lightfield_gs.commands.options.scene import add_antialiased, add_background, add_scene, add_view_filter

Add = Callable[..., argparse.Action]


def add_encoding(add: Add) -> None:
    """Add the options of how one input becomes an image, alone or in a batch."""
    add_panel(add, "for --preview, for framing, and for `simulate` afterwards")
    add_camera(add)
    add_look(add)
    add_depth_report(add)
    add_views(add)
    add_scene(
        add, "cut the object out of a photo with rembg (pip install 'lightfield-gs[rembg]'; it downloads 176 MB once)"
    )
    add_method(add)
    add_antialiased(add)
    add_view_filter(add)
    add_background(add)
    add_file(add)


def add_device(add: Add) -> None:
    """Add the option of the device."""
    add(
        "--device",
        choices=DEVICES,
        default="auto",
        help="device of network and rasterizer (default auto: cuda if there is a GPU and this build can use it)",
    )


def add_views(add: Add) -> None:
    """Add the options of cameras and a view map, in place of a rig and a lens."""
    add(
        "--cameras",
        type=Path,
        metavar="JSON",
        help="for --method sorted, in place of a rig: one camera for each view, the right-most eye's first, "
        "with world_to_camera [N,4,4] (OpenCV axes, scene units), focal_px [N,2] and principal_point_px "
        "[N,2] (pixels of the panel)",
    )
    add(
        "--view-map",
        type=Path,
        metavar="NPY",
        help="for --method sorted, in place of the panel's lens: the view of each sub-pixel, int32 [H,W,3], "
        "0..N-1, or -1 for the background",
    )


def add_method(add: Add) -> None:
    """Add the options of how the image is computed."""
    add(
        "--method",
        choices=METHODS,
        default="direct",
        help="direct: all sub-pixels in one pass; sorted: view by view, for any --cameras and --view-map; "
        "classic: one image per view, then interlaced (slow; for comparison); default direct",
    )
    add(
        "--memory-budget",
        type=byte_size,
        metavar="SIZE",
        help="work memory of --method sorted in addition to the image, for example 256MB (B, KB, MB, GB, KiB, "
        "MiB, GiB). Default: 256MiB, or 1GiB on cuda, plus the sorted sub-pixels, 0.2GB on an 8K panel",
    )
    add(
        "--views",
        choices=VIEWS,
        default="integer",
        help="integer: N views; continuous: a viewpoint of its own for every sub-pixel (default integer)",
    )
    add(
        "--quality",
        choices=QUALITY_NAMES,
        default="exact",
        help="of --method direct: less time for more error (default exact)",
    )


def add_file(add: Add) -> None:
    """Add the options of how the image is stored."""
    add(
        "--bit-depth",
        type=int,
        choices=(8, 16, 32),
        metavar="BITS",
        help="8, 16 or 32 (float: .exr, .tif); default 8, for .exr 32",
    )
    add(
        "--compression",
        choices=COMPRESSIONS,
        default="fast",
        help="fast: quick to write; small: a small file (default fast)",
    )
    add("--threads", type=threads, metavar="N", help="number of threads (default: all cores)")
