"""The arguments of `lightfield-gs calibrate pattern`."""

from __future__ import annotations

import argparse
from pathlib import Path

from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_quiet
from lightfield_gs.commands.options.panel import add_device_serial
from lightfield_gs.commands.options.parser import Parser, panel_name, whole, within

KINDS = {
    "hues": "each view in one hue, red (view 0) to magenta: an eye at the viewing distance sees one colour all over",
    "greys": "the same in greys, black to white",
    "numbers": "each view shows its own number, large",
    "single": "the views of --view white, the others black",
    "phase": "light that is a cosine of the view, shifted by --shift thirds of a lens: for `calibrate fit`",
    "rgb": "the same, red, green and blue shifted by 0, 1 and 2 thirds in one image",
    "pitch": "rows with the pitch changed by the percent written on them: the right one is even from left to right",
    "slope": "columns with the slope changed by the percent written on them: the right one is even from top to bottom",
    "centre": "rows with the centre moved by the lens widths on them: from straight in front the right one is white",
    "depth": "stripes at depths of the disparity, in pixels over all views, written on them; positive pops out",
}


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs calibrate pattern`."""
    parser.description = "Write a test picture that shows which view reaches an eye."
    parser.epilog = "Kinds: " + "; ".join(f"{kind}, {meaning}" for kind, meaning in KINDS.items()) + "."
    parser.text.examples = (
        ("calibrate pattern pitch -o p.png", "to compare pitches"),
        ("calibrate pattern phase --shift 0 -o 0.png", "to photograph, for `fit`"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "kind",
        choices=KINDS,
        metavar="KIND",
        short="pitch, slope, centre, phase, rgb, numbers, ...",
        help=", ".join(KINDS),
    )
    add(
        "--panel",
        type=panel_name,
        metavar="PANEL",
        short="the display (default: the one that is connected)",
        help=f"name, .yaml or visual.json of the panel (default: the display that is connected, else {DEFAULT_PANEL})",
    )
    add_device_serial(add)
    add(
        "--view",
        type=_views,
        metavar="N[-M]",
        help="of single: the white view, or the first and the last white view, from 0",
    )
    add(
        "--step",
        type=whole(1, 65536),
        metavar="VIEWS",
        help="of numbers: number of views with the same label (default: as many as blend)",
    )
    add(
        "--shift",
        type=whole(0, 2),
        metavar="0|1|2",
        short="of phase: 0, 1 or 2 thirds of a lens",
        help="of phase: thirds of a lens width (default 0)",
    )
    add(
        "--span",
        type=within(1e-6, 1e5),
        metavar="S",
        help="of pitch, slope (percent), centre (lens widths) and depth (pixels): the bands go from -S to S "
        "(default 0.5, 2.5, 0.5, and six lens widths)",
    )
    add(
        "--bands",
        type=whole(3, 99),
        metavar="COUNT",
        help="of the same kinds: number of bands, odd (default: as many as fit, at most 11)",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        short=".png or .tif",
        help=".png or .tif: show it unscaled, full screen",
    )
    add_quiet(add)


def _views(text: str) -> tuple[int, ...]:
    """Parse "40" to (40,), "40-44" to (40, 44)."""
    words = text.split("-")
    if len(words) > 2 or not all(word.isdecimal() and len(word) < 6 for word in words):
        raise argparse.ArgumentTypeError(f"expected a view such as 40, or a range such as 40-44, got '{text}'")
    return tuple(map(int, words))
