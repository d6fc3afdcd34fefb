"""The arguments of `lightfield-gs weave`."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from lightfield_gs.base.options import COMPRESSIONS, DEVICES, VIEWS
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_messages
from lightfield_gs.commands.options.panel import add_panel
from lightfield_gs.commands.options.parser import Parser, background, numbers, whole, whole_numbers, within

_FITS = ("cover", "contain", "stretch")

_INTERPOLATIONS = ("linear", "nearest")


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs weave`."""
    parser.description = "Turn a quilt, or a folder of views, into the picture of a glasses-free 3D display."
    parser.epilog = (
        "Each sub-pixel comes from its view, or from the two views beside it if the number of views differs from "
        "the panel's."
    )
    parser.text.examples = (
        ("weave robot_qs8x6a1.78.png -o out.png", "for the connected display"),
        ("weave views -o out.png --panel 27", "a folder of views"),
        ("weave film_qs8x6a1.78.mp4 -o out.mp4", "a video of quilts"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "input",
        type=Path,
        metavar="VIEWS",
        short="a quilt, a folder of views, or a video of either",
        help="a quilt (its tiles by its name, _qs<columns>x<rows>a<aspect>, its Exif, or --tiles), or a folder with a "
        "picture for each view, the left-most camera's first, by the number that varies; pictures named by row and "
        "column, an HCI light field (input_Cam000.png) or one of Stanford's (out_RR_CC_*.png); a video or an "
        "animation (.gif, .webp, .png, .avif) of quilts, or with --frames of views",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="PATH",
        short="the picture; of a video of quilts .mp4 or a folder",
        help=".png, .tif or .exr, of the views' bits; of a video of quilts a folder for PNG files, or .mp4, .mkv or "
        ".mov, which lose nothing",
    )
    add_panel(add, "for `simulate` afterwards")
    add(
        "--tiles",
        type=whole_numbers(1, 65536, "x", 2),
        metavar="CxR",
        short="columns and rows, where the name says none",
        help="columns and rows of a quilt, or of the cameras of a folder",
    )
    add(
        "--aspect",
        type=within(0.01, 100),
        metavar="A",
        short="width by height of a view",
        help="width by height of a view as it is seen (default: by the quilt's name, else by its pixels)",
    )
    add("--row", type=whole(0, 9999), metavar="R", help="of a light field, 0 the top one (default: the middle one)")
    add("--top-first", action="store_true", help="rows of a quilt go down from the top (default: up from the bottom)")
    add(
        "--right-to-left",
        action="store_true",
        short="views begin with the right-most camera's",
        help="views begin with the right-most camera's",
    )
    add(
        "--frames",
        type=_span,
        metavar="FIRST:LAST:STEP",
        help="frames of a video or an animation to take, from 0; each is a view, unless it is a quilt; 0:23 "
        "takes 24, : all",
    )
    add(
        "--view-map",
        type=Path,
        metavar="NPY",
        help="in place of the panel's lens: the view of each sub-pixel, int32 [H,W,3], 0 for the right-most "
        "camera's view, as in `encode`, or -1 for the background",
    )
    add(
        "--interpolation",
        choices=_INTERPOLATIONS,
        default="linear",
        help="between two views: mix them, or take the nearer one; unused if there are as many views as the "
        "panel has (default linear)",
    )
    add(
        "--views",
        choices=VIEWS,
        default="integer",
        help="viewpoint of a sub-pixel: its integer view of the panel's N, or its exact position (default integer)",
    )
    add(
        "--view-filter",
        type=within(0, 65536, "views"),
        default=0.0,
        metavar="VIEWS",
        help="angular anti-aliasing: show the mean over a box of this many views of the panel. Things far from "
        "the panel then flicker less as the eye moves, and are softer (default 0; 1 suits more views than "
        "the panel has, 2 as many)",
    )
    _add_framing(add)
    add(
        "--background",
        type=background,
        default=(0.0, 0.0, 0.0),
        metavar="COLOUR",
        help="R,G,B in 0..1, a name, or #rrggbb (default 0,0,0)",
    )
    add("--device", choices=DEVICES, default="auto", help="device of the interlacing (default auto)")
    add(
        "--compression",
        choices=COMPRESSIONS,
        default="fast",
        help="fast: quick to write; small: a small file (default fast)",
    )
    add("--overwrite", action="store_true", help="remove frames of another job from the folder")
    add_messages(add)


def _span(text: str):
    """Parse "FIRST:LAST:STEP", with any part missing, to the range of frames."""
    from lightfield_gs.view_sets.movies import FrameRange

    match = re.fullmatch(r"(\d{0,9}):(\d{0,9})(?::(\d{0,9}))?", text)
    first, last, step = (int(part) if part else None for part in (match.groups() if match else ("", "", "0")))
    if step == 0 or last is not None and last < (first or 0):
        raise argparse.ArgumentTypeError(f"expected FIRST:LAST or FIRST:LAST:STEP, such as 0:23:1, got '{text}'")
    return FrameRange(first or 0, last, step or 1)


def _add_framing(add) -> None:
    add(
        "--fit",
        choices=_FITS,
        default="cover",
        short="cover: crop; contain: show all; stretch",
        help="of views with another aspect than the panel: cut off the rest, show all before the background, or "
        "distort (default cover)",
    )
    add(
        "--crop",
        type=numbers(4),
        default=(0.0, 0.0, 0.0, 0.0),
        metavar="L,T,R,B",
        help="fractions 0..1 of each view to cut off first at its left, top, right and bottom",
    )
    add(
        "--shift",
        type=within(-1, 1),
        default=0.0,
        metavar="FRACTION",
        short="-1..1: move the scene back (above 0) or forth",
        help="re-converge: move the right-most view to the right against the left-most one by this many widths "
        "of a view, -1..1; above 0 the scene moves back, below 0 towards the viewer (default 0)",
    )
