"""Changes of a panel's lens, and panel profiles written back with them.

Looking Glass owners adjust three numbers: pitch, lenses per inch across their axis; slope, dy/dx of the axis
(-1/slant_tan); center, in lens widths. A panel has line_number, slant_tan and phase instead:
    line_number = 3 DPI / (pitch cos(slant))        phase falls by line_number where center grows by 1
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path, check_output_path
from lightfield_gs.io.text_files import MOST_BYTES, config_path, read_json, read_text
from lightfield_gs.panels.looking_glass import LIMIT_BYTES, calibration_values, find_calibration, replace_values
from lightfield_gs.panels.panel import Panel


@dataclass(frozen=True)
class LensChange:
    """Additions to the lens of a panel.

    The phase in the middle of the panel stays, unless centre or phase change.

    Attributes:
        pitch_percent: Percent of the lenses per inch.
        slope_percent: Percent of the slope. The lenses per inch across the axis stay, as if the sheet of lenses were
            turned.
        centre: Lens widths.
        line_number: Sub-pixels.
        slant_tan: Tangent of the slant.
        phase: Sub-pixels.
    """

    pitch_percent: float = 0.0
    slope_percent: float = 0.0
    centre: float = 0.0
    line_number: float = 0.0
    slant_tan: float = 0.0
    phase: float = 0.0


def middle_coordinate(panel: Panel) -> float:
    """Return D of the panel's middle less its phase, in sub-pixels: 3 j + k + 3 i slant_tan there."""
    pixel = 0 if panel.subpixel_cells else 1  # D of a pixel's centre, from its reference
    return 1.5 * (panel.width_px - 1) + pixel + 1.5 * (panel.height_px - 1) * panel.slant_tan


def replace_lens(panel: Panel, line_number: float, slant_tan: float, turns: float) -> Panel:
    """Return the panel with another lens, whose phase in the panel's middle is `turns` lens widths."""
    turned = replace(panel, line_number=line_number, slant_tan=slant_tan)
    return replace(turned, phase=turns * line_number - middle_coordinate(turned))


def phase_in_middle(panel: Panel) -> float:
    """Return the phase of the lens in the panel's middle, in lens widths."""
    return (middle_coordinate(panel) + panel.phase) / panel.line_number


def changed(panel: Panel, change: LensChange) -> Panel:
    """Return the panel with its lens changed.

    Raises:
        InputError: The change leaves no valid lens.
    """
    pitch = 1 + real_number("pitch change", change.pitch_percent, -90, 1000) / 100
    slope = 1 + real_number("slope change", change.slope_percent, -90, 1000) / 100
    if change.slope_percent and panel.slant_tan == 0:
        raise InputError("slope: the lenses stand upright, so that their slope is infinite; change slant_tan instead")
    slant = panel.slant_tan / slope
    per_axis = math.hypot(1, slant) / math.hypot(1, panel.slant_tan)  # ratio of 1/cos of the slants
    line_number = panel.line_number / pitch * per_axis + change.line_number
    try:
        turned = replace(panel, line_number=line_number, slant_tan=slant + change.slant_tan)
    except InputError as error:
        raise InputError(f"so large a change leaves no lens: {error}") from None
    phase = phase_in_middle(panel) * line_number - middle_coordinate(turned)
    return replace(turned, phase=phase + change.phase - change.centre * line_number)


_LENS_KEYS = ("line_number", "slant_tan", "phase")


def is_looking_glass(source: str | Path) -> bool:
    """Return whether Panel.load reads a profile as a Looking Glass calibration."""
    return str(source).lower().endswith(".json")


def check_profile_path(path: str | Path, source: str | Path) -> Path:
    """Return `path` if it can take the profile `source` in its own format; else raise InputError."""
    path = check_output_path(path)
    wanted = (".json",) if is_looking_glass(source) else (".yaml", ".yml")
    if path.suffix.lower() not in wanted:
        raise InputError(
            f"cannot write {path}: {source} is kept in its own format; give a name that ends in {wanted[0]}"
        )
    return path


def looking_glass_lens(source: str | Path, panel: Panel, serial: str | None = None) -> dict[str, float]:
    """Return pitch (lenses per inch), slope and center of a panel's lens for the Looking Glass calibration `source`.

    Raises:
        InputError: The calibration cannot be read, or cannot hold the lens.
    """
    data = find_calibration(read_json(source, LIMIT_BYTES), str(source), serial)
    return calibration_values(data, panel.line_number, panel.slant_tan, panel.phase, str(source))


def write_profile(path: str | Path, source: str | Path, panel: Panel, serial: str | None = None) -> None:
    """Write the profile `source` with the lens of `panel`: its line_number, slant_tan and phase.

    The file appears whole or not at all. A Looking Glass .json gets pitch, slope and center; a .yaml keeps its
    comments.

    Args:
        path: The file to write.
        source: A profile as Panel.load takes it.
        panel: The panel with the new lens.
        serial: The display, where a .json has several.

    Raises:
        InputError: The profile cannot be written in this form.
    """
    path = check_profile_path(path, source)
    if is_looking_glass(source):
        values = looking_glass_lens(source, panel, serial)
        data = replace_values(read_json(source, LIMIT_BYTES), str(source), serial, values)
        _write_checked(path, json.dumps(data, indent=1, ensure_ascii=False) + "\n", panel, serial)
    else:
        text = profile_text(source)
        for key in _LENS_KEYS:
            text = _replace_line(text, key, getattr(panel, key))
        _write_checked(path, text, panel, None)


def profile_text(source: str | Path) -> str:
    """Return the text of a profile, by its path or its name. Raises InputError."""
    if is_looking_glass(source):
        return read_text(source, LIMIT_BYTES, "JSON")
    is_file = Path(source).is_file() or Path(source).suffix.lower() in (".yaml", ".yml")
    return read_text(source if is_file else config_path("panels", str(source)), MOST_BYTES, "YAML")


def _replace_line(text: str, key: str, value: float) -> str:
    """Return the YAML with another value for a key, whose comment stays; a key that is missing is added."""
    changed, count = re.subn(rf"(?m)^({key}[ \t]*:[ \t]*)[^\s#]+", lambda match: f"{match[1]}{value!r}", text)
    return changed if count else f"{text.rstrip()}\n{key}: {value!r}\n"


def _write_checked(path: Path, text: str, panel: Panel, serial: str | None) -> None:
    """Write the text, if it reads as a profile with that lens."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
        try:
            written = Panel.load(temporary, serial=serial)
        except InputError as error:
            reason = str(error).replace(str(temporary), str(path))
            raise InputError(
                f"cannot write {path}: the lens cannot be set in a profile of this form ({reason})"
            ) from None
        lenses = (written.phase - panel.phase) / panel.line_number  # whole ones change nothing
        errors = (
            written.line_number / panel.line_number - 1,
            written.slant_tan - panel.slant_tan,
            lenses - round(lenses),
        )
        if max(map(abs, errors)) > 1e-6:
            raise InputError(
                f"cannot write {path}: the lens cannot be set in a profile of this form; expected one key a line"
            )
