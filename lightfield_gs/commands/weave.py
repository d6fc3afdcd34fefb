"""`lightfield-gs weave`: the views of a quilt, a folder, a light field or a video become the image of a panel."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.panel import load_panel
from lightfield_gs.base.cli_messages import Stopwatch, say
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import COMPRESSIONS, DEVICES, VIEWS
from lightfield_gs.commands.options.panel import add_panel
from lightfield_gs.commands.options.parser import background, numbers, read_options, whole, whole_numbers, within
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.io.images import check_image_path, write_image

if TYPE_CHECKING:
    import numpy as np

    from lightfield_gs.app.weaving import WeaveOptions

_FITS = ("cover", "contain", "stretch")
_INTERPOLATIONS = ("linear", "nearest")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `lightfield-gs weave`."""
    parser.description = (
        "Interlace views for a panel: each sub-pixel comes from its view, or from the two views beside it "
        "if the number of views differs from the panel's."
    )
    add = parser.add_argument
    add(
        "input",
        type=Path,
        metavar="VIEWS",
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
        help=".png, .tif or .exr, of the views' bits; of a video of quilts a folder for PNG files, or .mp4, .mkv or "
        ".mov, which lose nothing",
    )
    add_panel(add, "for `simulate` afterwards")
    add(
        "--tiles",
        type=whole_numbers(1, 65536, "x", 2),
        metavar="CxR",
        help="columns and rows of a quilt, or of the cameras of a folder",
    )
    add(
        "--aspect",
        type=within(0.01, 100),
        metavar="A",
        help="width by height of a view as it is seen (default: by the quilt's name, else by its pixels)",
    )
    add("--row", type=whole(0, 9999), metavar="R", help="of a light field, 0 the top one (default: the middle one)")
    add("--top-first", action="store_true", help="rows of a quilt go down from the top (default: up from the bottom)")
    add("--right-to-left", action="store_true", help="views begin with the right-most camera's")
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
        help="re-converge: move the right-most view to the right against the left-most one by this many widths "
        "of a view, -1..1; above 0 the scene moves back, below 0 towards the viewer (default 0)",
    )


def run(args: argparse.Namespace) -> None:
    """Weave args.input into args.output. Raises InputError."""
    watch = Stopwatch(args.began)
    from lightfield_gs.app.weaving import WeaveOptions

    _weave(read_options(WeaveOptions, args), watch)


def _weave(options: WeaveOptions, watch: Stopwatch) -> None:
    from lightfield_gs.app.weaving import interpolation_words, say_colours, weave_arguments, weave_metadata, weave_movie
    from lightfield_gs.encoding.view_files import read_view_map
    from lightfield_gs.encoding.weave import weave
    from lightfield_gs.view_sets.movies import is_movie
    from lightfield_gs.view_sets.view_set import QuiltMovie, open_views

    source, output = options.input, options.output
    if not is_movie(source):  # the tiles of a movie decide its use
        check_image_path(output)
    check_outputs((output,), (source, options.panel.panel, options.view_map))
    panel = load_panel(options.panel)
    found = open_views(
        source,
        options.tiles,
        row=options.row,
        top_first=options.top_first,
        right_to_left=options.right_to_left,
        span=options.frames,
        background=options.background,
        keeps_linear=output.suffix.lower() == ".exr",
    )
    if isinstance(found, QuiltMovie):
        weave_movie(options, panel, found, watch)
        return
    check_image_path(output)
    if options.overwrite:
        raise InputError("--overwrite is about folders of frames; leave it out")
    views = found.views
    view_map = None if options.view_map is None else read_view_map(options.view_map, panel, views.count)
    watch.lap("load")
    image = weave(views, panel, **weave_arguments(options, panel, views, found.aspect, view_map)).cpu()
    watch.lap("weave")
    metadata = weave_metadata(options, panel, views.count)
    write_image(output, _to_file_type(output, image.numpy()), metadata, options.compression)
    watch.lap("write")
    print(f"{output}: {panel.width_px} x {panel.height_px}, {panel.views} views")
    print(watch.line())
    size = f"{views.width_px} x {views.height_px} pixels each"
    say(f"{source}: {found.description}, {size}; {interpolation_words(options, views, panel)}")
    say_colours(found.colours)


def _to_file_type(path: Path, image: np.ndarray) -> np.ndarray:
    """Return the image in the type that the file takes: .png takes no floats, .exr nothing else."""
    from lightfield_gs.io.images import as_floats
    from lightfield_gs.show.preview import to_integers

    suffix = path.suffix.lower()
    if suffix == ".exr":
        return as_floats(image)
    return to_integers(image, 16) if suffix == ".png" and image.dtype.name == "float32" else image
