"""Looks that users keep: depth, size, turn and the like under a name, for all pictures, until they are removed."""

from __future__ import annotations

import math
import threading
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.system import settings_folder
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.io.text_files import parse_json, read_object, write_json
from lightfield_gs.show.page.server import Answer, Query, Route, as_json

_MOST_LOOKS, _LONGEST_NAME, _MOST_BYTES = 100, 60, 1 << 20
# What a look may hold. focus: in depths of the scene's own plane; background: #rrggbb, or "" for the scene's own
_NUMBERS = ("depth_amount", "focus", "cone_deg", "zoom", "pan_x", "pan_y", "yaw_deg", "pitch_deg")
Look = dict[str, Any]


def looks_path() -> Path:
    """Return the file of this user's looks."""
    return settings_folder() / "looks.json"


class LookStore:
    """Looks by their names, in a file.

    Args:
        path: The file; it is written with the first look.
    """

    def __init__(self, path: Path):
        self._path, self._turn = path, threading.Lock()

    def looks(self) -> dict[str, Look]:
        """Return the looks in the order of their names. Raises InputError where the file is damaged."""
        if not self._path.is_file():
            return {}
        kept = read_object(self._path, _MOST_BYTES)
        return {name: _checked(kept[name]) for name in sorted(kept, key=str.casefold)}

    def keep(self, name: str, look: Look) -> None:
        """Keep a look; one of the same name is replaced. Raises InputError."""
        name = " ".join(name.split())
        if not 1 <= len(name) <= _LONGEST_NAME:
            raise InputError(f"a look needs a name of 1..{_LONGEST_NAME} letters, got {len(name)}")
        with self._turn:
            looks = {**self.looks(), name: _checked(look)}
            if len(looks) > _MOST_LOOKS:
                raise InputError(f"{_MOST_LOOKS} looks are kept already; remove one")
            self._write(looks)

    def remove(self, name: str) -> None:
        """Remove a look; there may be none of this name."""
        with self._turn:
            self._write({other: look for other, look in self.looks().items() if other != name})

    def _write(self, looks: dict[str, Look]) -> None:
        make_folder(self._path.parent)
        write_json(looks, self._path)


def _checked(look: object) -> Look:
    """Return a look of known values alone. Raises InputError."""
    if not isinstance(look, dict):
        raise InputError("a look is an object with numbers")
    numbers = {name: look[name] for name in _NUMBERS if name in look}
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
            raise InputError(f"look: {name} must be a number, got {value!r:.40}")
    background = look.get("background", "")
    if not isinstance(background, str) or len(background) > len("#rrggbb"):
        raise InputError(f"look: background must be a colour #rrggbb, got {background!r:.40}")
    return {**numbers, "background": background}


def look_routes(store: LookStore, token: str) -> dict[str, Route]:
    """Return the addresses that list, keep and remove looks."""

    def keep(query: Query) -> Answer:
        store.keep(query.get("name", ""), parse_json(query.get("look", "")))
        return as_json(store.looks())

    def remove(query: Query) -> Answer:
        store.remove(query.get("name", ""))
        return as_json(store.looks())

    return {
        "/looks.json": Route(lambda query: as_json(store.looks())),
        "/looks/keep": Route(keep, token),
        "/looks/remove": Route(remove, token),
    }
