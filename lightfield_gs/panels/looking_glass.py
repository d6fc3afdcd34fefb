"""Looking Glass calibrations: visual.json, and the answers of Looking Glass Bridge and its predecessors.

A display keeps its calibration in visual.json, a flat mapping. Other programs store Bridge's answer. There each display
has, beside other data, a calibration as a mapping or as JSON within a string.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import expect, is_row, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEFAULT_CONE_DEG
from lightfield_gs.io.text_files import parse_json, read_json
from lightfield_gs.panels.cells import PATTERNS

LOOKING_GLASS = "looking-glass"  # the name of their panels
_MARKS = frozenset(("pitch", "slope", "center"))  # a mapping with two of these keys is a calibration
_SERIALS = ("serial", "hwid")  # the keys of a calibration, and of its display
_NUMBERS = (
    "pitch",
    "slope",
    "center",
    "DPI",
    "screenW",
    "screenH",
    "viewCone",
    "invView",
    "verticalAngle",
    "fringe",
    "flipImageX",
    "flipImageY",
    "flipSubp",
    "CellPatternMode",
)
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_USUAL_NAMES = {key.casefold(): key for key in (*_NUMBERS, "subpixelCells")}
_DEEPEST = 16
_MOST_LISTED = 8


@dataclass
class _Calibration:
    """A calibration in a file.

    Attributes:
        data: Its values.
        serials: Names of its display; empty without any.
        path: Keys that lead to it.
    """

    data: dict[str, Any]
    serials: tuple[str, ...]
    path: tuple[Any, ...]

    @property
    def name(self) -> str:
        return _short(self.serials[0]) if self.serials else f"{_key_path(self.path)} (without a serial)"


def find_calibration(data: Any, where: str, serial: str | None = None) -> dict[str, Any]:
    """Return the calibration in `data`, flat: {"pitch": 47.0, ...}; strings of numbers become numbers.

    Without a cone the result has no viewCone, and the default is assumed.

    Args:
        data: A calibration, whose values may be plain or {"value": v}; or mappings and lists of any kind that hold
            some.
        where: Name of the file, for messages.
        serial: Serial number of the calibration or of the display, if there are several.

    Raises:
        InputError: There is no such calibration; the message names the file and the key.
    """
    try:
        found = _choose(_distinct(_calibrations(data)), where, serial)
    except RecursionError:
        raise InputError(f"{where}: its lists and mappings are nested too deeply") from None
    if found.path:
        where = f"{where}: {_key_path(found.path)}"
    flat = {
        key: _parsed_number(value, key, where) if key in _NUMBERS else value
        for key, value in _usual_keys(found.data, where).items()
    }
    if isinstance(flat.get("subpixelCells"), list):
        flat["subpixelCells"] = [
            _parsed_cell(cell, f"{where}: subpixelCells[{number}]") for number, cell in enumerate(flat["subpixelCells"])
        ]
    cone = flat.get("viewCone")
    if cone is None or type(cone) in (int, float) and cone == 0:
        flat.pop("viewCone", None)
        given = "not given" if cone is None else 0
        assume(
            f"a viewing cone of {DEFAULT_CONE_DEG:g} degrees, {where}: viewCone is {given}; on a display of "
            "another cone there is more depth than it can show, or less"
        )
    return flat


def calibration_serials(data: Any) -> list[tuple[str, ...]]:
    """Return the serial numbers of each calibration in `data` and of its display, in its order; see find_calibration.

    Args:
        data: See find_calibration.
    """
    try:
        return [one.serials for one in _distinct(_calibrations(data))]
    except RecursionError:
        return []


def _choose(found: list[_Calibration], where: str, serial: str | None) -> _Calibration:
    if not found:
        raise InputError(
            f"{where}: expected a Looking Glass calibration with pitch, slope, center, DPI, screenW and "
            "screenH, found none"
        )
    names = ", ".join(one.name for one in found[:_MOST_LISTED]) + ", ..." * (len(found) > _MOST_LISTED)
    if serial is None:
        if len(found) > 1:
            raise InputError(
                f"{where} has calibrations of {len(found)} displays: {names}; say which with serial=SERIAL"
            )
        return found[0]
    expect("serial", serial, str)
    named = [one for one in found if serial.strip().casefold() in map(str.casefold, one.serials)]
    if len(named) != 1:
        count = "no calibration" if not named else f"{len(named)} different calibrations"
        raise InputError(f"{where} has {count} of a display with serial {shown(serial)}; it has {names}")
    return named[0]


def replace_values(data: Any, where: str, serial: str | None, values: dict[str, float]) -> Any:
    """Return a copy of `data` with other values in the calibration that find_calibration finds, all else as it was.

    Values keep their form: plain or {"value": v}, numbers or strings, JSON within strings. If the same calibration
    occurs several times, all occurrences are changed.

    Args:
        data: See find_calibration.
        where: See find_calibration.
        serial: See find_calibration.
        values: The new values by key.

    Raises:
        InputError: As find_calibration.
    """
    try:
        found = list(_calibrations(data))
        chosen = repr(_choose(_distinct(iter(found)), where, serial).data)
        paths = [one.path for one in found if repr(one.data) == chosen]
    except RecursionError:
        raise InputError(f"{where}: its lists and mappings are nested too deeply") from None
    for path in paths:
        data = _replace(data, path, values)
    return data


def _replace(node: Any, path: tuple[Any, ...], values: dict[str, float]) -> Any:
    if isinstance(node, str):
        return json.dumps(_replace(_parse(node), path, values))
    if not path:
        return {key: _in_form(old, values.get(_usual_name(key))) for key, old in node.items()}
    copy = node.copy()
    copy[path[0]] = _replace(node[path[0]], path[1:], values)
    return copy


def _in_form(old: Any, new: float | None) -> Any:
    """Return the new value in the form of the old one; the old one for None."""
    if new is None:
        return old
    if isinstance(old, dict):
        return {**old, "value": _in_form(old["value"], new)}
    return repr(new) if isinstance(old, str) else new


def _distinct(found: Iterator[_Calibration]) -> list[_Calibration]:
    """Return the distinct calibrations, each with all names of its display."""
    out: dict[str, _Calibration] = {}
    for one in found:
        first = out.setdefault(repr(one.data), one)
        first.serials = tuple(dict.fromkeys((*first.serials, *one.serials)))
    return list(out.values())


def _calibrations(data: Any) -> Iterator[_Calibration]:
    """Yield all calibrations, in the order of the file."""
    pending: list[tuple[Any, tuple[Any, ...], tuple[str, ...]]] = [(data, (), ())]
    visited: dict[int, Any] = {}  # by identity, in case one holds itself; kept alive, so that no identity comes twice
    while pending:
        value, path, serials = pending.pop()
        if isinstance(value, str):
            value = _parse(value)
        if not isinstance(value, (dict, list)) or len(path) > _DEEPEST:
            continue
        if isinstance(value, dict):
            plain = {key: _unwrap(part) for key, part in value.items()}
            own_serials = _serials(plain)
            if len(_MARKS & {_usual_name(key) for key in plain}) > 1:
                yield _Calibration(plain, (*own_serials, *serials), path)
                continue
            serials = own_serials or serials
        if id(value) in visited:
            continue
        visited[id(value)] = value
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        pending += reversed([(part, (*path, key), serials) for key, part in parts])


def _serials(mapping: dict[Any, Any]) -> tuple[str, ...]:
    return tuple(
        str(mapping[key]).strip()
        for key in _SERIALS
        if type(mapping.get(key)) in (str, int) and str(mapping[key]).strip()
    )


def _key_path(path: tuple[Any, ...]) -> str:
    """Return a path of keys, for example "devices.0.calibration"."""
    return ".".join(_short(key) for key in path) or "the whole"


def _short(word: Any) -> str:
    return " ".join(str(word).split())[:40]


def _parse(text: str) -> Any:
    """Return the JSON in a string; None where it is none."""
    if not text.lstrip().startswith(("{", "[")):
        return None
    try:
        return parse_json(text)
    except ValueError:
        return None


def _unwrap(value: Any) -> Any:
    return value["value"] if isinstance(value, dict) and "value" in value else value


def _usual_keys(data: dict[Any, Any], where: str) -> dict[Any, Any]:
    """Return the mapping with known keys in their usual spelling, so that cellPatternMode is not overlooked."""
    named = {_usual_name(key): value for key, value in data.items()}
    if len(named) < len(data):
        raise InputError(f"{where}: expected each key once, got some that differ in capitals only")
    return named


def _usual_name(key: Any) -> Any:
    return _USUAL_NAMES.get(key.casefold(), key) if isinstance(key, str) else key


def _parsed_cell(cell: Any, where: str) -> Any:
    """Return a cell with its strings as numbers; return anything else unchanged."""
    return (
        {key: _parsed_number(_unwrap(value), key, where) for key, value in cell.items()}
        if isinstance(cell, dict)
        else cell
    )


def _parsed_number(value: Any, key: str, where: str) -> Any:
    """Return the number in a string; return anything else unchanged."""
    if not isinstance(value, str):
        return value
    text = value.strip()
    if not _NUMBER.fullmatch(text):
        hint = "; write it with a point" if _NUMBER.fullmatch(text.replace(",", ".", 1)) else ""
        raise InputError(f"{where}: {key} must be a number, got {shown(value)}{hint}")
    return float(text)


LIMIT_BYTES = 1 << 20


def panel_fields(
    source: str | Path | dict[str, Any] | list[Any], views: int, serial: str | None = None, flip_center: float = 0.0
) -> dict[str, Any]:
    """Return fields of Panel from visual.json, or from other data with calibrations (see find_calibration).

    Needed are pitch (lenses per inch across the axis), slope, center (lens widths), DPI, screenW and screenH. Optional
    are viewCone (degrees), flipSubp, flipImageX, invView, subpixelCells and CellPatternMode. u and v run right and up
    over the panel, 0..1. By Looking Glass' own shaders the view value of a sub-pixel is N (1 - frac(a)) with
        a = (u + place + v tilt) pitch' - center,  pitch' = pitch W/DPI cos(atan(1/slope)),  tilt = H/(W slope)
    place is c/(3 W) for channel c, 2 - c with flipSubp; of a cell its x/W + y/H tilt. flipImageX turns tilt and c
    round. With P_e = 3 W/pitch' and tan(theta) = -tilt W/H it is D/P_e = a.

    Args:
        source: The path, or the parsed content.
        views: Views of the panel.
        serial: See find_calibration.
        flip_center: See Panel.from_looking_glass.

    Raises:
        InputError: The file cannot be read, or a value is missing or invalid.
    """
    expect("calibration", source, dict, list, str, Path)
    where, given = "Looking Glass calibration", source
    if isinstance(source, (str, Path)):
        where, given = str(source), read_json(source, LIMIT_BYTES)
    data = find_calibration(given, where, serial)
    pitch, slope, center, dpi, width, height = (
        _required_number(data, key, where) for key in ("pitch", "slope", "center", "DPI", "screenW", "screenH")
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
        "name": LOOKING_GLASS,
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
        fields["cone_deg"] = _required_number(data, "viewCone", where)
    if "invView" in data:  # 1 on every display as shipped: their view value is N - x
        fields["invert_views"] = _required_number(data, "invView", where) == 0
    return fields


def calibration_values(
    data: dict[str, Any], line_number: float, slant_tan: float, phase: float, where: str
) -> dict[str, float]:
    """Return the pitch, slope and center with which panel_fields makes this lens of a calibration.

    Centers repeat from lens to lens; the result is the center nearest to the calibration's.

    Args:
        data: The calibration, see find_calibration.
        line_number: See Panel.
        slant_tan: See Panel.
        phase: See Panel.
        where: Name of the file, for messages.

    Raises:
        InputError: The lenses stand upright, which no slope can express.
    """
    if slant_tan == 0:
        raise InputError(f"{where}: slant_tan 0 has no slope; keep the panel in a .yaml")
    dpi, height, before = (_required_number(data, key, where) for key in ("DPI", "screenH", "center"))
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
    """Return the fields subpixel_cells and cell_pattern of Panel; none for a panel of stripes."""
    cells = data.get("subpixelCells")
    if cells is not None and not is_row(cells):
        raise InputError(f"{where}: subpixelCells must be a list, got {shown(cells)}")
    pattern = _required_number(data, "CellPatternMode", where) if "CellPatternMode" in data else 0
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
        "subpixel_cells": [
            _cell_offsets(cell, f"{where}: subpixelCells[{number}]") for number, cell in enumerate(cells)
        ],
        "cell_pattern": int(pattern),
    }


def _cell_offsets(cell: Any, where: str) -> list[list[float]]:
    if not isinstance(cell, dict):
        raise InputError(f"{where} must be an object with ROffsetX, ROffsetY and so on, got {shown(cell)}")
    return [[_required_number(cell, f"{colour}Offset{axis}", where) for axis in "XY"] for colour in "RGB"]


def _is_set(data: dict[str, Any], key: str, where: str) -> bool:
    return key in data and _required_number(data, key, where) != 0


def _required_number(data: dict[str, Any], key: str, where: str) -> float:
    if key not in data:
        raise InputError(
            f"{where}: missing {key}; a visual.json has pitch, slope, center, DPI, screenW, screenH, and "
            "six offsets for each of its subpixelCells"
        )
    value = data[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not -1e300 < value < 1e300:  # false for NaN
        raise InputError(f"{where}: {key} must be a number, got {shown(value)}")
    return value
