"""The calibration file of a Looking Glass display, visual.json."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from lightfield_gs.checks import expect, shown
from lightfield_gs.errors import InputError
from lightfield_gs.io.calibration_file import find_calibration
from lightfield_gs.io.json_file import read_json

_LIMIT_BYTES = 1 << 20


def panel_fields(source: str | Path | dict[str, Any] | list[Any], views: int,
                 serial: str | None = None) -> dict[str, Any]:
    """Fields of Panel from visual.json, or from what holds calibrations otherwise (see find_calibration).

    Used are pitch (lenses per inch across the axis), slope, center (lens widths), DPI, screenW, screenH, and
    optionally viewCone (degrees), flipSubp and invView.
    P_e = 3 DPI / (pitch cos(atan(1/slope))), tan(theta) = -1/slope, D_0 = 1.5 + 3 (H - 0.5)/slope - center P_e.
    Raises InputError when the file cannot be read, or a value is missing or makes no sense.
    """
    expect("calibration", source, dict, list, str, Path)
    is_file = isinstance(source, (str, Path))
    where = str(source) if is_file else "Looking Glass calibration"
    data = find_calibration(read_json(source, _LIMIT_BYTES) if is_file else source, where, serial)
    pitch, slope, center, dpi, width, height = (
        _number(data, key, where) for key in ("pitch", "slope", "center", "DPI", "screenW", "screenH"))
    if pitch <= 0 or dpi <= 0 or abs(slope) < 0.1:
        raise InputError(f"{where}: expected pitch > 0, DPI > 0 and |slope| >= 0.1, got {pitch}, {dpi}, {slope}")
    line_number = 3 * dpi / (pitch * math.cos(math.atan(1 / slope)))
    fields = {"width_px": width, "height_px": height, "views": views, "line_number": line_number,
              "slant_tan": -1 / slope, "phase": 1.5 + 3 * (height - 0.5) / slope - center * line_number,
              "pixel_pitch_mm": 25.4 / dpi, "name": "looking-glass"}
    if "viewCone" in data:
        fields["cone_deg"] = _number(data, "viewCone", where)
    if "flipSubp" in data and _number(data, "flipSubp", where):
        fields["subpixel_order"] = "BGR"
    if "invView" in data:  # 1 on every display as shipped: their view value is N - x
        fields["invert_views"] = _number(data, "invView", where) == 0
    for key in ("flipImageX", "flipImageY"):
        if key in data and _number(data, key, where):
            raise InputError(f"{where}: {key} is set; mirrored displays are not supported, turn the display instead")
    return fields


def _number(data: dict[str, Any], key: str, where: str) -> float:
    if key not in data:
        raise InputError(f"{where}: missing {key}; a visual.json has pitch, slope, center, DPI, screenW, screenH")
    value = data[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not -1e300 < value < 1e300:  # not for NaN
        raise InputError(f"{where}: {key} must be a number, got {shown(value)}")
    return value
