"""Profiles of panels written back in the format that they came in, with another lens and all else as it was."""

from __future__ import annotations

import json
import re
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.paths import config_path
from lightfield_gs.io.atomic import atomic_path, check_output_path
from lightfield_gs.io.json_file import read_json
from lightfield_gs.io.text_file import read_text
from lightfield_gs.io.yaml_file import MOST_BYTES
from lightfield_gs.panels.looking_glass import find_calibration, with_values
from lightfield_gs.panels.looking_glass import LIMIT_BYTES, calibration_values
from lightfield_gs.panels.panel import Panel

_LENS_KEYS = ("line_number", "slant_tan", "phase")


def is_looking_glass(source: str | Path) -> bool:
    """Whether Panel.load reads a profile as a Looking Glass calibration."""
    return str(source).lower().endswith(".json")


def check_profile_path(path: str | Path, source: str | Path) -> Path:
    """`path`, if the profile `source` can be written there in its own format; raises InputError."""
    path = check_output_path(path)
    wanted = (".json",) if is_looking_glass(source) else (".yaml", ".yml")
    if path.suffix.lower() not in wanted:
        raise InputError(
            f"cannot write {path}: {source} is kept in its own format; give a name that ends in {wanted[0]}"
        )
    return path


def lens_in_owners_terms(source: str | Path, panel: Panel, serial: str | None = None) -> dict[str, float]:
    """pitch (lenses per inch), slope and center of a panel's lens, as the Looking Glass calibration `source` has them.

    Raises InputError.
    """
    data = find_calibration(read_json(source, LIMIT_BYTES), str(source), serial)
    return calibration_values(data, panel.line_number, panel.slant_tan, panel.phase, str(source))


def write_profile(path: str | Path, source: str | Path, panel: Panel, serial: str | None = None) -> None:
    """Writes the profile `source` with the lens of `panel`: its line_number, slant_tan and phase.

    source: as Panel.load takes it. A Looking Glass .json gets pitch, slope and center instead, in the calibration of
    `serial`; a .yaml keeps its comments. The file appears whole or not at all. Raises InputError.
    """
    path = check_profile_path(path, source)
    if is_looking_glass(source):
        values = lens_in_owners_terms(source, panel, serial)
        data = with_values(read_json(source, LIMIT_BYTES), str(source), serial, values)
        _write_checked(path, json.dumps(data, indent=1, ensure_ascii=False) + "\n", panel, serial)
    else:
        is_file = Path(source).is_file() or Path(source).suffix.lower() in (".yaml", ".yml")
        text = read_text(source if is_file else config_path("panels", str(source)), MOST_BYTES, "YAML")
        for key in _LENS_KEYS:
            text = _with_line(text, key, getattr(panel, key))
        _write_checked(path, text, panel, None)


def _with_line(text: str, key: str, value: float) -> str:
    """The YAML with another value on the line of a key, whose comment stays; a line at the end where it has none."""
    changed, count = re.subn(rf"(?m)^({key}[ \t]*:[ \t]*)[^\s#]+", lambda match: f"{match[1]}{value!r}", text)
    return changed if count else f"{text.rstrip()}\n{key}: {value!r}\n"


def _write_checked(path: Path, text: str, panel: Panel, serial: str | None) -> None:
    """Writes the text, if it reads as a profile with that lens."""
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
