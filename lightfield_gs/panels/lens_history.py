"""The history of a profile: every lens that it had, in a file beside it, and the way back to each.

Each line of NAME.history.jsonl is a state: its number, the number of the state before it, when and by what it came, and
the text of the profile. Undo adds a line that leads to an earlier state; nothing is ever lost.
"""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.text_files import parse_json, read_text
from lightfield_gs.panels.lens_change import profile_text, write_profile
from lightfield_gs.panels.panel import Panel

_MOST_BYTES = 64 << 20  # of a history: thousands of states
_LENS = ("line_number", "slant_tan", "phase")


@dataclass(frozen=True)
class LensState:
    """A state of a profile.

    Attributes:
        number: From 1 on.
        before: Number of the state that it was made from; None for the first.
        when: Local time, ISO 8601.
        what: The change that led to it, in words.
        lens: line_number, slant_tan and phase; nothing where the profile could not be read.
        text: The profile's text.
        is_undo: Whether the line only leads back to the state of this number.
    """

    number: int
    before: int | None
    when: str
    what: str
    lens: dict[str, float]
    text: str
    is_undo: bool = False


@dataclass(frozen=True)
class LensHistory:
    """The states of a profile, in the order of their numbers, and the number of the one that it has."""

    states: tuple[LensState, ...]
    current: int

    def state(self, number: int) -> LensState:
        """Return a state; raise InputError where there is none of this number."""
        for one in self.states:
            if one.number == number:
                return one
        raise InputError(f"state {number}: expected one of 1..{len(self.states)}")


def history_path(profile: str | Path) -> Path:
    """Return the file of a profile's history."""
    path = Path(profile)
    return path.with_name(f"{path.name}.history.jsonl")


def read_history(profile: str | Path) -> LensHistory:
    """Return the history of a profile; without any states where none was kept. Raises InputError."""
    path = history_path(profile)
    lines = _lines(path) if path.exists() else []
    states = tuple(line for line in lines if not line.is_undo)
    return LensHistory(states, lines[-1].number if lines else 0)


def write_kept(path: Path, source: str | Path, panel: Panel, serial: str | None, what: str) -> None:
    """Write the profile `source` with the lens of `panel`, as write_profile does, and keep what was there before.

    Args:
        path: The file to write; its history lies beside it.
        source: A profile as Panel.load takes it.
        panel: The panel with the new lens.
        serial: The display, where a .json has several.
        what: The change, in words.

    Raises:
        InputError: The profile cannot be written.
    """
    origin = path if path.is_file() else source
    before = profile_text(origin)
    _keep(path, before, _lens(Panel.load(origin, serial=serial)), f"as in {origin}")
    write_profile(path, source, panel, serial)
    _keep(path, profile_text(path), _lens(panel), what)


def undo(profile: Path, number: int | None = None, serial: str | None = None) -> tuple[LensState, LensState]:
    """Write an earlier state of a profile back, and return the states it had and has.

    Args:
        profile: The file of the profile.
        number: The state to go back to; None: the one before that of now.
        serial: The display, where a .json has several.

    Raises:
        InputError: There is no such state.
    """
    if not read_history(profile).states:
        raise InputError(f"{profile}: nothing to undo, for `calibrate` has not changed it")
    if profile.is_file():  # a change by hand is kept too
        text = profile_text(profile)
        lens: dict[str, float] = {}
        with suppress(InputError):  # what is broken is kept as well
            lens = _lens(Panel.load(profile, serial=serial))
        _keep(profile, text, lens, "changed by hand")
    history = read_history(profile)
    now = history.state(history.current)
    wanted = now.before if number is None else number
    if wanted is None:
        raise InputError(f"{profile}: nothing to undo, it is as it was at first")
    then = history.state(wanted)
    with atomic_path(profile) as temporary:
        temporary.write_text(then.text, encoding="utf-8")
    _append(profile, LensState(then.number, None, _now(), "undone", then.lens, "", is_undo=True))
    return now, then


def _keep(path: Path, text: str, lens: dict[str, float], what: str) -> None:
    """Add a state, unless the current one has this text."""
    history = read_history(path)
    if history.states and history.state(history.current).text == text:
        return
    before = history.current or None
    _append(path, LensState(len(history.states) + 1, before, _now(), what, lens, text))


def _append(profile: Path, state: LensState) -> None:
    path = history_path(profile)
    kept = path.read_text(encoding="utf-8") if path.exists() else ""
    with atomic_path(path) as temporary:
        temporary.write_text(f"{kept}{json.dumps(asdict(state), ensure_ascii=False)}\n", encoding="utf-8")


def _lines(path: Path) -> list[LensState]:
    """Return all lines of a history. Raises InputError."""
    lines = []
    for number, line in enumerate(read_text(path, _MOST_BYTES, "a history of a profile").splitlines(), 1):
        try:
            values: Any = parse_json(line)
            lines.append(LensState(**values))
        except (ValueError, TypeError):
            raise InputError(
                f"{path}: line {number} is no state of a profile, got {shown(line)}; move the file away"
            ) from None
    return lines


def _lens(panel: Panel) -> dict[str, float]:
    return {key: getattr(panel, key) for key in _LENS}


def _now() -> str:
    return datetime.now().isoformat(" ", "seconds")
