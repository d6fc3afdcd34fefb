"""The panel of a command: by its name, or of an encoded image, and what looks wrong with it."""

from __future__ import annotations

import argparse
import math
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import read_info
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import missing_geometry

_REMEDIES = {"viewing_distance_mm": "give --viewing-distance MM", "pixel_pitch_mm": "give a panel that has it"}


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
    missing = missing_geometry(panel)
    if not missing:
        return None
    return f"panel {panel.name} lacks {' and '.join(missing)}; {', and '.join(_REMEDIES[key] for key in missing)}"


def stored_panel(args: argparse.Namespace) -> Panel:
    """The panel that args.image was encoded for. Raises InputError where it does not say."""
    if args.device_serial is not None:
        raise InputError("--device-serial chooses among the calibrations of a --panel; give one, or leave it out")
    stored = read_info(args.image).metadata.get("panel")
    if stored is None:
        raise InputError(f"{args.image} does not say which panel it is for; give --panel")
    return profile(args.image, stored)


def profile(image: Path, stored: str) -> Panel:
    """A panel from what is stored in an image. Raises InputError."""
    try:
        return Panel(**parse_json(stored))
    except (TypeError, ValueError) as error:
        raise InputError(f"{image}: its panel profile cannot be used ({error}); give --panel") from None
