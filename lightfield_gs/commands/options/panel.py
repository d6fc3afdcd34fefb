"""The panel of a command, and where its viewer stands."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from lightfield_gs.base.cli_messages import note
from lightfield_gs.commands.options.values import within
from lightfield_gs.panels.panel import DEFAULT_PANEL, Panel
from lightfield_gs.panels.simulate import unknown_of

_REMEDIES = {"viewing_distance_mm": "give --viewing-distance MM", "pixel_pitch_mm": "give a panel that has it"}


def add_panel(add: Callable[..., argparse.Action], purpose: str) -> None:
    """The panel that is drawn for, and what it is seen from."""
    add(
        "--panel",
        default=DEFAULT_PANEL,
        metavar="PANEL",
        help=f"name of a profile, a .yaml or a Looking Glass visual.json (default {DEFAULT_PANEL})",
    )
    add_device_serial(add)
    add_viewing_distance(add, f"distance of the viewer from the panel, in place of the panel's own: {purpose}")


def add_device_serial(add: Callable[..., argparse.Action]) -> None:
    add(
        "--device-serial",
        metavar="SERIAL",
        help="which display, where a Looking Glass .json has calibrations of several",
    )


def add_viewing_distance(add: Callable[..., argparse.Action], help: str) -> None:
    add("--viewing-distance", type=within(1e-3, 1e9, "mm"), metavar="MM", help=help)


def load_panel(args: argparse.Namespace) -> Panel:
    """The panel of --panel and --device-serial, seen from --viewing-distance, or from its own.

    Says where its numbers look as if they were in other units. Raises InputError.
    """
    version = None
    with suppress(OSError):  # its reader says what is wrong with it
        found = Path(args.panel).stat()
        version = found.st_size, found.st_mtime_ns
    panel = at_distance(_panel(args.panel, args.device_serial, version), args.viewing_distance)
    for doubt in doubts_of_units(panel):
        note(f"panel {panel.name}: {doubt}")
    return panel


@lru_cache(maxsize=8)
def _panel(name: str, serial: str | None, version: tuple[int, int] | None) -> Panel:
    """A panel that is read once, however many inputs the command takes, and again when its file is another."""
    return Panel.load(name, serial=serial)


def doubts_of_units(panel: Panel) -> list[str]:
    """What of a panel is hardly meant so, and what it may be instead."""
    slant, cone, distance, pitch = (panel.slant_tan, panel.cone_deg, panel.viewing_distance_mm, panel.pixel_pitch_mm)
    doubts = []
    if abs(slant) > 1:
        doubts.append(
            f"slant_tan {slant:g} leans the lenses by {math.degrees(math.atan(slant)):.3g} degrees; if it is "
            f"the slant in degrees, write its tangent, {math.tan(math.radians(slant)):.6g}"
        )
    if cone < 2:
        doubts.append(f"cone_deg {cone:g} is hardly a cone; if it is in radians, write {math.degrees(cone):.6g}")
    if distance is not None and distance < 20:
        doubts.append(
            f"viewing_distance_mm {distance:g} is hardly a distance of eyes; if it is in metres, write "
            f"{1000 * distance:g}"
        )
    if pitch is not None and not 0.01 <= pitch <= 20:
        doubts.append(f"pixel_pitch_mm {pitch:g} is hardly the width of a pixel (0.05 to 1 mm of most displays)")
    return doubts


def at_distance(panel: Panel, viewing_distance_mm: float | None) -> Panel:
    """The panel, seen from this distance in mm; None: from its own."""
    return panel if viewing_distance_mm is None else replace(panel, viewing_distance_mm=viewing_distance_mm)


def why_no_eye(panel: Panel) -> str | None:
    """Why no eye can be placed before the panel, and what to do; None where one can."""
    missing = unknown_of(panel)
    if not missing:
        return None
    return f"panel {panel.name} lacks {' and '.join(missing)}; {', and '.join(_REMEDIES[key] for key in missing)}"
