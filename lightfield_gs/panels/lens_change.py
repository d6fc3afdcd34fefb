"""Small changes of a panel's lens, in the terms that the owner of a display turns: pitch, slope and centre.

Looking Glass names them so: pitch, lenses per inch across their axis; slope, dy/dx of the axis (-1/slant_tan); center,
in lens widths. A panel has line_number, slant_tan and phase instead:
    line_number = 3 DPI / (pitch cos(slant))        phase falls by line_number where center grows by 1
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel


@dataclass(frozen=True)
class LensChange:
    """What is added to the lens of a panel.

    pitch_percent: of the lenses per inch; slope_percent: of the slope, lenses per inch across the axis kept, as if the
    sheet of lenses were turned; centre: lens widths. line_number: sub-pixels; slant_tan; phase: sub-pixels.
    What the middle of the panel shows stays, unless centre or phase are changed: they follow pitch and slope.
    """

    pitch_percent: float = 0.0
    slope_percent: float = 0.0
    centre: float = 0.0
    line_number: float = 0.0
    slant_tan: float = 0.0
    phase: float = 0.0


def middle_of(panel: Panel) -> float:
    """D of the panel's middle less its phase, in sub-pixels: (3 j + k + 3 i slant_tan) there."""
    pixel = 0 if panel.subpixel_cells else 1  # D of a pixel's centre, from its reference
    return 1.5 * (panel.width_px - 1) + pixel + 1.5 * (panel.height_px - 1) * panel.slant_tan


def with_lens(panel: Panel, line_number: float, slant_tan: float, turns: float) -> Panel:
    """The panel with another lens, whose phase in the panel's middle is `turns` lens widths."""
    turned = replace(panel, line_number=line_number, slant_tan=slant_tan)
    return replace(turned, phase=turns * line_number - middle_of(turned))


def turns_in_middle(panel: Panel) -> float:
    """Phase of the lens in the panel's middle, in lens widths."""
    return (middle_of(panel) + panel.phase) / panel.line_number


def changed(panel: Panel, change: LensChange) -> Panel:
    """The panel with its lens changed. Raises InputError where the lens comes to be none."""
    pitch = 1 + real_number("pitch change", change.pitch_percent, -90, 1000) / 100
    slope = 1 + real_number("slope change", change.slope_percent, -90, 1000) / 100
    if change.slope_percent and panel.slant_tan == 0:
        raise InputError("slope: the lenses stand upright, so that their slope is infinite; change slant_tan instead")
    slant = panel.slant_tan / slope
    per_axis = math.hypot(1, slant) / math.hypot(1, panel.slant_tan)  # 1/cos of the new slant over that of the old
    line_number = panel.line_number / pitch * per_axis + change.line_number
    try:
        turned = replace(panel, line_number=line_number, slant_tan=slant + change.slant_tan)
    except InputError as error:
        raise InputError(f"so large a change leaves no lens: {error}") from None
    phase = turns_in_middle(panel) * line_number - middle_of(turned)
    return replace(turned, phase=phase + change.phase - change.centre * line_number)
