"""`lightfield-gs weave`: the views of a quilt, a folder or a light field become the image of a panel."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import COMPRESSIONS, DEVICES, VIEWS
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.panel import add_panel, load_panel
from lightfield_gs.commands.options.provenance import package_versions, software
from lightfield_gs.commands.options.values import background, numbers, whole, whole_numbers, within
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout, stated_layout

_FITS = ("cover", "contain", "stretch")
_INTERPOLATIONS = ("linear", "nearest")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs weave`."""
    parser.description = (
        "Interlaces views for a panel: each sub-pixel from the view that it shows, or from the two beside it where "
        "there are more or fewer views than the panel has."
    )
    add = parser.add_argument
    add(
        "input",
        type=Path,
        metavar="VIEWS",
        help="a quilt (its tiles by its name, _qs<columns>x<rows>a<aspect>, or --tiles), or a folder with a picture "
        "for each view, the left-most camera's first, by number or name; an HCI light field (input_Cam000.png, "
        "parameters.cfg) or one of Stanford's (out_RR_CC_*.png)",
    )
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=".png, .tif or .exr, of the views' bits")
    add_panel(add, "for `simulate` afterwards")
    add("--tiles", type=whole_numbers(1, 65536, "x", 2), metavar="CxR", help="columns and rows of a quilt")
    add(
        "--aspect",
        type=within(0.01, 100),
        metavar="A",
        help="width by height of a view as it is seen (default: what the quilt's name says, else that of its pixels)",
    )
    add("--row", type=whole(0, 9999), metavar="R", help="of a light field, 0 the top one (default: the middle one)")
    add("--right-to-left", action="store_true", help="pictures of a folder begin with the right-most camera's")
    add(
        "--view-map",
        type=Path,
        metavar="NPY",
        help="the view of each sub-pixel in place of the panel's lens: int32 [H,W,3], 0 for the right-most camera's "
        "view, as `encode` takes it, or -1 for the background",
    )
    add(
        "--interpolation",
        choices=_INTERPOLATIONS,
        default="linear",
        help="between two views: mix them, or take the nearer one; none is needed where there are as many as the "
        "panel has (default linear)",
    )
    add(
        "--views",
        choices=VIEWS,
        default="integer",
        help="where a sub-pixel looks from: its integer view of the panel's N, or its exact place (default integer)",
    )
    add(
        "--view-filter",
        type=within(0, 65536, "views"),
        default=0.0,
        metavar="VIEWS",
        help="angular anti-aliasing: show the mean over a box of so many views of the panel; what stands far from it "
        "flickers less as the eye moves, and is softer (default 0; 1 suits more views than the panel has, 2 as many)",
    )
    _add_framing(add)
    add("--background", type=background, default=(0.0, 0.0, 0.0), metavar="R,G,B", help="0..1 each (default 0,0,0)")
    add("--device", choices=DEVICES, default="auto", help="where the views are woven (default auto)")
    add("--compression", choices=COMPRESSIONS, default="fast", help="of the file: quick to write, or small")


def _add_framing(add) -> None:
    add(
        "--fit",
        choices=_FITS,
        default="cover",
        help="of views of another aspect than the panel: cut off what does not fit, show all before the background, "
        "or distort (default cover)",
    )
    add(
        "--crop",
        type=numbers(4),
        default=(0.0, 0.0, 0.0, 0.0),
        metavar="L,T,R,B",
        help="shares 0..1 of each view that are cut off first at its left, top, right and bottom",
    )
    add(
        "--shift",
        type=within(-1, 1),
        default=0.0,
        metavar="SHARE",
        help="re-converge: how far the right-most view moves to the right against the left-most, in widths of a view, "
        "-1..1; above 0 the scene moves back, below 0 towards the viewer (default 0)",
    )


def run(args: argparse.Namespace) -> None:
    """Weaves args.input into args.output. Raises InputError."""
    watch = Stopwatch(args.began)
    check_image_path(args.output)
    check_outputs((args.output,), (args.input, args.panel, args.view_map))
    panel = load_panel(args)
    from lightfield_gs.encoding.view_files import read_view_map
    from lightfield_gs.encoding.view_sets import open_views
    from lightfield_gs.encoding.weave import weave

    found = open_views(
        args.input, _layout(args), row=args.row, right_to_left=args.right_to_left, background=args.background
    )
    views = found.views
    table = None if args.view_map is None else read_view_map(args.view_map, panel, views.count)
    watch.lap("load")
    image = weave(
        views,
        panel,
        interpolation=args.interpolation,
        place=args.views,
        view_filter=args.view_filter,
        view_map=table,
        aspect=args.aspect or found.aspect,
        fit=args.fit,
        crop=args.crop,
        shift=args.shift,
        background=args.background,
        device=choose_device(args.device),
    ).cpu()
    watch.lap("weave")
    write_image(args.output, _stored(args.output, image.numpy()), _metadata(args, panel, views.count), args.compression)
    watch.lap("write")
    print(f"{args.output}: {panel.width_px} x {panel.height_px}, {panel.views} views")
    print(watch.line())
    print(f"{args.input}: {found.said}, {views.width_px} x {views.height_px} pixels each; {_words(args, views, panel)}")


def _words(args: argparse.Namespace, views, panel: Panel) -> str:
    """How views became those of the panel."""
    exact = args.view_map is not None or views.count == panel.views and args.views == "integer"
    if args.view_filter * (1 if args.view_map is not None else views.count / panel.views) > 1:
        return f"{views.count} views for the panel's {panel.views}: means over {args.view_filter:g} views of the panel"
    if exact:
        return "every sub-pixel is that of one view"
    return f"{views.count} views for the panel's {panel.views}: {args.interpolation} between them"


def _layout(args: argparse.Namespace) -> QuiltLayout | None:
    """What --tiles says of a quilt, in place of its name. Raises InputError."""
    if args.tiles is None:
        return None
    if args.input.is_dir():
        raise InputError(f"--tiles is about a quilt, and {args.input} is a folder; leave it out")
    from lightfield_gs.io.images import read_info

    info = read_info(args.input)
    columns, rows = args.tiles
    try:
        stated = stated_layout(args.input)
    except InputError:  # which --tiles is there to mend
        stated = None
    aspect = args.aspect or (stated.aspect if stated else (info.width_px / columns) / (info.height_px / rows))
    return QuiltLayout(columns, rows, aspect)


def _stored(path: Path, image):
    """In the type that the file takes: .png takes no floats, .exr nothing else."""
    from lightfield_gs.io.images import as_floats
    from lightfield_gs.show.preview import to_integers

    suffix = path.suffix.lower()
    if suffix == ".exr":
        return as_floats(image)
    return to_integers(image, 16) if suffix == ".png" and image.dtype.name == "float32" else image


def _metadata(args: argparse.Namespace, panel: Panel, count: int) -> dict[str, str]:
    """What the image was made from and for; the values but "software" and "input" are JSON."""
    weaving = {
        "method": "weave",
        "source_views": count,
        "interpolation": args.interpolation,
        "views": args.views,
        **({"view_filter": args.view_filter} if args.view_filter else {}),
        "fit": args.fit,
        "crop": list(args.crop),
        "shift": args.shift,
    }
    return {
        "software": software(),
        "input": args.input.name,
        "panel": json.dumps(panel.to_dict()),
        "encoding": json.dumps(weaving),
        "versions": json.dumps(package_versions()),
    }
