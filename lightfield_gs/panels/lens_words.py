"""A change of a lens in words: pitch, slope and centre of a Looking Glass, and the numbers of a .yaml."""

from __future__ import annotations

import math
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.lens_change import is_looking_glass, looking_glass_lens, phase_in_middle
from lightfield_gs.panels.panel import Panel

LARGE = 0.02  # relative change of pitch or slope that is hardly meant; chosen by hand


def large_changes(before: Panel, after: Panel) -> str:
    """Return in words which of pitch and slope change by more than the usual; "" where none does."""
    slants = before.slant_tan, after.slant_tan
    pitch = before.line_number / after.line_number * math.hypot(1, slants[1]) / math.hypot(1, slants[0]) - 1
    slope = slants[0] / slants[1] - 1 if all(slants) else math.inf * (slants[0] != slants[1])
    found = {"pitch": pitch, "slope": slope}
    return " and ".join(
        f"the {name} changes by {100 * change:+.3g} %" for name, change in found.items() if abs(change) > LARGE + 1e-9
    )


def pitch_lpi(panel: Panel) -> float:
    """Return the lenses per inch across their axis. Raises InputError where the profile has no pixel pitch."""
    if panel.pixel_pitch_mm is None:
        raise InputError(
            f"panel {panel.name} lacks pixel_pitch_mm, without which there are no lenses per inch; give the change "
            "of pitch in percent, as 0.1%, or --line-number-by"
        )
    return 3 * 25.4 / (panel.pixel_pitch_mm * panel.line_number) * math.hypot(1, panel.slant_tan)


def lens_slope(source: str | Path, panel: Panel, serial: str | None) -> float:
    """Return dy/dx of the lens axis, as the profile has it. Raises InputError where the lenses stand upright."""
    if is_looking_glass(source):
        return looking_glass_lens(source, panel, serial)["slope"]
    if panel.slant_tan == 0:
        raise InputError(f"panel {panel.name}: the lenses stand upright, without a slope; give --slant-by")
    return -1 / panel.slant_tan


def change_lines(source: str | Path, before: Panel, after: Panel, serial: str | None) -> list[str]:
    """Return lines on the lens before and after, in the terms of a Looking Glass, if any, and of a .yaml."""
    lines = []
    if is_looking_glass(source):
        old, new = (looking_glass_lens(source, panel, serial) for panel in (before, after))
        lines.append(", ".join(f"{key} {old[key]:.9g} -> {new[key]:.9g}" for key in old))
    elif before.pixel_pitch_mm is not None and before.slant_tan and after.slant_tan:
        pitch = f"pitch {pitch_lpi(before):.9g} -> {pitch_lpi(after):.9g} lenses per inch"
        lines.append(f"{pitch}, slope {-1 / before.slant_tan:.9g} -> {-1 / after.slant_tan:.9g}")
    keys = ("line_number", "slant_tan", "phase")
    lines.append(", ".join(f"{key} {getattr(before, key):.9g} -> {getattr(after, key):.9g}" for key in keys))
    moved = phase_in_middle(after) - phase_in_middle(before)
    lines.append(f"the middle of the panel moves by {moved:+.4g} lens widths, {moved * after.views:+.4g} views")
    return lines
