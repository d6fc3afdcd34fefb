"""The options of `lightfield-gs encode` that no other command has, and what they say together."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import COMPRESSIONS, DEVICES, METHODS, QUALITY_NAMES, VIEWS, of_other_methods
from lightfield_gs.commands.options.camera import add_camera
from lightfield_gs.commands.options.drawn import add_antialiased, add_background, add_view_filter
from lightfield_gs.commands.options.look import add_depth_report, add_look, refuse_look
from lightfield_gs.commands.options.panel import add_panel
from lightfield_gs.commands.options.rig import load_cameras
from lightfield_gs.commands.options.scene import add_scene, check_scene_options
from lightfield_gs.commands.options.values import byte_size, threads
from lightfield_gs.panels.panel import Panel

Add = Callable[..., argparse.Action]


def add_encoding(add: Add) -> None:
    """All that says how one input becomes an image, whether it is alone or one of many."""
    add_panel(add, "for --preview, for framing, and for `simulate` afterwards")
    add_camera(add)
    add_look(add)
    add_depth_report(add)
    add_views(add)
    add_scene(
        add, "cut the object out of a photo with rembg (pip install 'lightfield-gs[rembg]'; downloads 176 MB once)"
    )
    add_method(add)
    add_antialiased(add)
    add_view_filter(add)
    add_background(add)
    add_file(add)


def add_device(add: Add) -> None:
    add(
        "--device",
        choices=DEVICES,
        default="auto",
        help="where network and rasterizer run (default auto: cuda where there is a GPU and this build can use it)",
    )


def add_views(add: Add) -> None:
    """Cameras and a view map in place of a rig and a lens."""
    add(
        "--cameras",
        type=Path,
        metavar="JSON",
        help="one camera for each view, the right-most eye's first, for --method sorted, in place of a rig: "
        "world_to_camera [N,4,4] (OpenCV axes, scene units), focal_px [N,2] and principal_point_px [N,2] (pixels of "
        "the panel)",
    )
    add(
        "--view-map",
        type=Path,
        metavar="NPY",
        help="the view of each sub-pixel, for --method sorted, in place of the panel's lens: int32 [H,W,3], 0..N-1, or "
        "-1 for the background",
    )


def add_method(add: Add) -> None:
    """How the image is computed."""
    add(
        "--method",
        choices=METHODS,
        default="direct",
        help="direct: all sub-pixels in one pass; sorted: view by view, for any --cameras and --view-map; classic: a "
        "picture a view, then interlaced (slow; for comparison)",
    )
    add(
        "--memory-budget",
        type=byte_size,
        metavar="SIZE",
        help="work memory of --method sorted beside the image, for example 256MB (B, KB, MB, GB, KiB, MiB, GiB; "
        "default 256MiB, or 1GiB on cuda, beside the sorted sub-pixels, 0.2GB on an 8K panel)",
    )
    add(
        "--views",
        choices=VIEWS,
        default="integer",
        help="integer: N views; continuous: every sub-pixel its own viewpoint (default integer)",
    )
    add(
        "--quality",
        choices=QUALITY_NAMES,
        default="exact",
        help="less time for more error, of --method direct (default exact)",
    )


def add_file(add: Add) -> None:
    """How the image is stored."""
    add(
        "--bit-depth",
        type=int,
        choices=(8, 16, 32),
        metavar="BITS",
        help="8, 16 or 32 (float: .exr, .tif); default 8, .exr 32",
    )
    add("--compression", choices=COMPRESSIONS, default="fast", help="of the file: quick to write, or small")
    add("--threads", type=threads, metavar="N", help="number of threads (default: all cores)")


def check_options(args: argparse.Namespace) -> None:
    """Raises InputError where options do not go together."""
    check_scene_options(args)
    quality = None if args.quality == "exact" else args.quality
    given = {"cameras": args.cameras, "view_map": args.view_map, "memory_budget": args.memory_budget}
    for name, its in of_other_methods(args.method, **given, quality=quality):
        if name == "quality":
            raise InputError(f"--quality {quality} is for --method {its}, not {args.method}; leave out one of them")
        raise InputError(f"--{name.replace('_', '-')} is for --method {its}, not {args.method}")
    for option, value in (("--cameras", args.cameras), ("--view-map", args.view_map)):
        if value is not None and args.views == "continuous":
            raise InputError(
                f"--views continuous is for a rig and the panel's lens, and {option} takes the place of "
                "one; leave out one of them"
            )
    if args.cameras is not None:
        for option, value in (
            ("--view-filter", args.view_filter or None),
            ("--rig", args.rig),
            ("--camera", args.camera),
            ("--up", args.up),
            ("--save-rig", args.save_rig),
            ("--preview", args.preview),
            ("--depth-report", args.depth_report or None),
        ):
            if value is not None:
                raise InputError(f"{option} is about a rig, and --cameras takes its place; leave out one of them")
        refuse_look(args, "is about a rig, and --cameras takes its place")


def views_given(args: argparse.Namespace, panel: Panel) -> dict[str, Any]:
    """The arguments of `encode` that only the method sorted has, those that were given."""
    from lightfield_gs.encoding.view_files import read_view_map

    views: dict[str, Any] = {}
    if args.cameras is not None:
        views["cameras"] = load_cameras(args, panel)
    if args.view_map is not None:
        count = views["cameras"].count if "cameras" in views else panel.views
        views["view_map"] = read_view_map(args.view_map, panel, count)
    if args.memory_budget is not None:
        views["memory_budget"] = args.memory_budget
    return views


def bits_of(path: Path, bit_depth: int | None) -> int:
    """Bits of a sample in the file: 8, 16 or 32 (float)."""
    suffix = path.suffix.lower()
    bits = bit_depth or (32 if suffix == ".exr" else 8)
    if (suffix == ".exr") != (bits == 32) and suffix not in (".tif", ".tiff"):
        raise InputError(
            f"{path}: {suffix} holds {'32' if suffix == '.exr' else '8 or 16'} bits, not {bits}; "
            "change --bit-depth or the extension"
        )
    return bits
