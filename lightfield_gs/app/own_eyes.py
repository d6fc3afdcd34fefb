"""The eyes and the screen of this user: asked for once, at a terminal, and kept."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.cli_messages import ask_number, can_ask
from lightfield_gs.base.system import settings_folder
from lightfield_gs.io.atomic import make_folder
from lightfield_gs.io.text_files import read_object, write_json
from lightfield_gs.panels.stereo_screen import StereoScreen

_EYES_MM, _SCREENS_IN = (20.0, 120.0), (0.5, 2000.0)
_MOST_BYTES = 1 << 16


class OwnEyes(NamedTuple):
    """What pictures of two eyes are made for.

    Attributes:
        eye_distance_mm: Between the eyes.
        diagonal_in: Of the screen, inches.
        kept_in: The file that they are kept in; None: they are the usual ones.
    """

    eye_distance_mm: float = StereoScreen.eye_distance_mm
    diagonal_in: float = StereoScreen.diagonal_in
    kept_in: Path | None = None


def own_eyes() -> OwnEyes:
    """Return the numbers that are kept; without them ask at a terminal and keep the answers, or else the usual ones.

    Raises:
        InputError: The file is damaged, or cannot be written.
    """
    path = settings_folder() / "eyes.json"
    if path.is_file():
        kept = read_object(path, _MOST_BYTES)
        eyes = real_number(f"{path}: eye_distance_mm", kept.get("eye_distance_mm"), *_EYES_MM)
        return OwnEyes(eyes, real_number(f"{path}: screen_size_in", kept.get("screen_size_in"), *_SCREENS_IN), path)
    if not can_ask():
        return OwnEyes()
    eyes = ask_number("How far apart are your eyes, in mm?", OwnEyes().eye_distance_mm, *_EYES_MM)
    screen = ask_number("How large is the screen, inches across its corners?", OwnEyes().diagonal_in, *_SCREENS_IN)
    make_folder(path.parent)
    write_json({"eye_distance_mm": eyes, "screen_size_in": screen}, path)
    return OwnEyes(eyes, screen, path)
