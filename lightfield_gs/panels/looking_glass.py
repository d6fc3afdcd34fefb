"""The calibration file of a Looking Glass display, visual.json."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from lightfield_gs.base.checks import expect, is_row, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.json_file import read_json
from lightfield_gs.panels.looking_glass import find_calibration
from lightfield_gs.panels.cells import PATTERNS

LIMIT_BYTES = 1 << 20


def panel_fields(
    source: str | Path | dict[str, Any] | list[Any], views: int, serial: str | None = None, flip_center: float = 0.0
) -> dict[str, Any]:
    """Fields of Panel from visual.json, or from what holds calibrations otherwise (see find_calibration).

    Used are pitch (lenses per inch across the axis), slope, center (lens widths), DPI, screenW, screenH, and
    optionally viewCone (degrees), flipSubp, flipImageX, invView, subpixelCells and CellPatternMode. The view value of
    a sub-pixel is N (1 - frac(a)), u and v running right and up over the panel, 0..1 (Looking Glass' own shaders):
        a = (u + place + v tilt) pitch' - center,  pitch' = pitch W/DPI cos(atan(1/slope)),  tilt = H/(W slope)
    place is c/(3 W) for channel c, 2 - c with flipSubp; of a cell its x/W + y/H tilt. flipImageX turns tilt and c
    round. With P_e = 3 W/pitch' and tan(theta) = -tilt W/H it is D/P_e = a.
    Raises InputError when the file cannot be read, or a value is missing or makes no sense.
    """
    expect("calibration", source, dict, list, str, Path)
    where, given = "Looking Glass calibration", source
    if isinstance(source, (str, Path)):
        where, given = str(source), read_json(source, LIMIT_BYTES)
    data = find_calibration(given, where, serial)
    pitch, slope, center, dpi, width, height = (
        _number(data, key, where) for key in ("pitch", "slope", "center", "DPI", "screenW", "screenH")
    )
    if pitch <= 0 or dpi <= 0 or abs(slope) < 0.1:
        raise InputError(f"{where}: expected pitch > 0, DPI > 0 and |slope| >= 0.1, got {pitch}, {dpi}, {slope}")
    if _is_set(data, "flipImageY", where):
        raise InputError(
            f"{where}: flipImageY is set; no published program says what it does to the lens, and this "
            "one does not guess: turn the display, or describe the panel in a .yaml"
        )
    for key, meaning in (
        ("verticalAngle", "cameras looking from above or below"),
        ("fringe", "a correction of colours"),
    ):
        if _is_set(data, key, where):
            raise InputError(f"{where}: {key} is set, {meaning}, which is not known here; set it to 0 to do without")
    line_number = 3 * dpi / (pitch * math.cos(math.atan(1 / slope)))
    mirrored, blue_first = _is_set(data, "flipImageX", where), _is_set(data, "flipSubp", where)
    slant_tan = (1 if mirrored else -1) / slope
    center += flip_center if mirrored else 0
    fields: dict[str, Any] = {
        "width_px": width,
        "height_px": height,
        "views": views,
        "line_number": line_number,
        "slant_tan": slant_tan,
        "phase": 1.5 - 3 * (height - 0.5) * slant_tan - center * line_number,
        "pixel_pitch_mm": 25.4 / dpi,
        "name": "looking-glass",
    }
    if found := _cells(data, where):
        if blue_first:
            raise InputError(
                f"{where}: flipSubp is set beside subpixelCells, which say where each colour lies; set it to 0"
            )
        fields |= found
    else:
        fields["phase"] -= 2 if mirrored else 0  # places count down from 0: -c is (2 - c) - 2
        fields["subpixel_order"] = "BGR" if mirrored != blue_first else "RGB"
    if "viewCone" in data:
        fields["cone_deg"] = _number(data, "viewCone", where)
    if "invView" in data:  # 1 on every display as shipped: their view value is N - x
        fields["invert_views"] = _number(data, "invView", where) == 0
    return fields


def calibration_values(
    data: dict[str, Any], line_number: float, slant_tan: float, phase: float, where: str
) -> dict[str, float]:
    """pitch, slope and center with which panel_fields makes this lens of the calibration `data` (find_calibration).

    Of the centers, which repeat from lens to lens, the one nearest to that of `data`. Raises InputError where the
    lenses stand upright, which a slope cannot say.
    """
    if slant_tan == 0:
        raise InputError(f"{where}: slant_tan 0 has no slope; keep the panel in a .yaml")
    dpi, height, before = (_number(data, key, where) for key in ("DPI", "screenH", "center"))
    mirrored = _is_set(data, "flipImageX", where)
    slope = (1 if mirrored else -1) / slant_tan
    start = 1.5 - 3 * (height - 0.5) * slant_tan - (2 if mirrored and not data.get("subpixelCells") else 0)
    center = (start - phase) / line_number
    return {
        "pitch": 3 * dpi / (line_number * math.cos(math.atan(1 / slope))),
        "slope": slope,
        "center": center + round(before - center),
    }


def _cells(data: dict[str, Any], where: str) -> dict[str, Any]:
    """The fields subpixel_cells and cell_pattern of Panel; none for a panel of stripes."""
    cells = data.get("subpixelCells")
    if cells is not None and not is_row(cells):
        raise InputError(f"{where}: subpixelCells must be a list, got {shown(cells)}")
    pattern = _number(data, "CellPatternMode", where) if "CellPatternMode" in data else 0
    if pattern not in PATTERNS:
        raise InputError(f"{where}: CellPatternMode {pattern:g} is not known; known: {', '.join(map(str, PATTERNS))}")
    if not cells:
        if pattern:
            raise InputError(
                f"{where}: CellPatternMode is {pattern:g}, but there are no subpixelCells; expected both, "
                "or CellPatternMode 0"
            )
        return {}
    return {
        "subpixel_cells": [_cell(cell, f"{where}: subpixelCells[{number}]") for number, cell in enumerate(cells)],
        "cell_pattern": int(pattern),
    }


def _cell(cell: Any, where: str) -> list[list[float]]:
    if not isinstance(cell, dict):
        raise InputError(f"{where} must be an object with ROffsetX, ROffsetY and so on, got {shown(cell)}")
    return [[_number(cell, f"{colour}Offset{axis}", where) for axis in "XY"] for colour in "RGB"]


def _is_set(data: dict[str, Any], key: str, where: str) -> bool:
    return key in data and _number(data, key, where) != 0


def _number(data: dict[str, Any], key: str, where: str) -> float:
    if key not in data:
        raise InputError(
            f"{where}: missing {key}; a visual.json has pitch, slope, center, DPI, screenW, screenH, and "
            "six offsets for each of its subpixelCells"
        )
    value = data[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not -1e300 < value < 1e300:  # false for NaN
        raise InputError(f"{where}: {key} must be a number, got {shown(value)}")
    return value
