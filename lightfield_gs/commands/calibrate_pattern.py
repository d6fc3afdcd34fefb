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
from lightfield_gs.base.cli_messages import say_next
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.io.images import check_image_path, write_image
from lightfield_gs.panels import patterns
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.patterns import Fan

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
    say_next("show", path)
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
