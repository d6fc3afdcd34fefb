"""`lightfield-gs calibrate pattern`: a native image that shows which view reaches an eye."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import cast

import numpy as np

from lightfield_gs.app.options import PanelOptions
from lightfield_gs.app.panel import load_panel
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.options.panel import add_device_serial
from lightfield_gs.commands.options.parser import read_options, whole, within
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.panels import patterns
from lightfield_gs.panels.panel import DEFAULT_PANEL, Panel
from lightfield_gs.panels.patterns import Fan

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
# The options that only some kinds take
_TAKERS = {
    "view": ("single",),
    "step": ("numbers",),
    "shift": ("phase",),
    "span": ("pitch", "slope", "centre", "depth"),
    "bands": ("pitch", "slope", "centre", "depth"),
}


@dataclass(frozen=True, slots=True)
class PatternOptions:
    """A calibration pattern. Options that the kind does not take are None.

    Attributes:
        kind: of KINDS.
        view: of "single": the white view, or the first and the last.
        step: of "numbers": how many views share a number.
        shift: of "phase": thirds of a lens.
        span: largest change or disparity of the bands.
        bands: their number.
    """

    kind: str
    view: tuple[int, ...] | None = None
    step: int | None = None
    shift: int | None = None
    span: float | None = None
    bands: int | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `lightfield-gs calibrate pattern`."""
    parser.epilog = "Kinds: " + "; ".join(f"{kind}, {meaning}" for kind, meaning in KINDS.items()) + "."
    add = parser.add_argument
    add("kind", choices=KINDS, metavar="KIND", help=", ".join(KINDS))
    add(
        "--panel",
        metavar="PANEL",
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
    add("--shift", type=whole(0, 2), metavar="0|1|2", help="of phase: thirds of a lens width (default 0)")
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
    add("-o", "--output", type=Path, required=True, metavar="FILE", help=".png or .tif: show it unscaled, full screen")


def run(args: argparse.Namespace) -> None:
    """Write the pattern of args.kind. Raises InputError."""
    options = read_options(PatternOptions, args)
    path = check_image_path(args.output)
    check_outputs((path,), (args.panel,))
    panel = load_panel(PanelOptions(args.panel, args.device_serial))
    for option, takers in _TAKERS.items():
        if getattr(options, option) is not None and options.kind not in takers:
            raise InputError(f"--{option} is for the kinds {', '.join(takers)}, not {options.kind}; leave it out")
    write_pattern(path, panel, options.kind, draw_pattern(panel, options))
    print(
        f"{path}: {options.kind}, {panel.width_px} x {panel.height_px}, for panel {panel.name}; show it full screen, "
        "unscaled"
    )
    if options.kind == "numbers":
        shared = math.ceil(panel.views / len(np.unique(patterns.displayed_numbers(panel, options.step))))
        print(
            f"{shared} of {panel.views} views share a number; a lens lights about {panel.views / panel.line_number:.3g}"
        )


def draw_pattern(panel: Panel, options: PatternOptions) -> np.ndarray:
    """Return the pattern, uint8 [H, W, 3]. Raises InputError."""
    kind = options.kind
    if kind in ("hues", "greys"):
        return patterns.sweep(panel, kind == "hues")
    if kind == "numbers":
        return patterns.numbers(panel, options.step)
    if kind == "single":
        return patterns.single(panel, *(options.view or (panel.views // 2,)))
    if kind in ("phase", "rgb"):
        return patterns.bars(panel, None if kind == "rgb" else options.shift or 0)
    if kind == "depth":
        return patterns.depth_ramp(panel, options.span, options.bands)
    return patterns.fan(panel, cast(Fan, kind), options.span, options.bands)


def write_pattern(path: Path, panel: Panel, kind: str, image: np.ndarray) -> None:
    """Write a pattern with the panel that it is for, as `simulate` reads it. Raises InputError."""
    told = {
        "software": f"lightfield-gs {version('lightfield-gs')}",
        "pattern": kind,
        "panel": json.dumps(panel.to_dict()),
    }
    write_image(path, image, metadata=told)


def _views(text: str) -> tuple[int, ...]:
    """Parse "40" to (40,), "40-44" to (40, 44)."""
    words = text.split("-")
    if len(words) > 2 or not all(word.isdecimal() and len(word) < 6 for word in words):
        raise argparse.ArgumentTypeError(f"expected a view such as 40, or a range such as 40-44, got '{text}'")
    return tuple(map(int, words))
