"""Which axis of a scene points up: what a file says of it, and how a camera stands by it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError

UP_AXES = ("x", "y", "z", "-x", "-y", "-z")
DEFAULT_UP = "-y"  # OpenCV axes: y points down
_PREFIX = "vertical axis"
# Where an upright camera looks for each axis that points up: along +z as ever where up is along y downwards, along -z
# where y is up (OpenGL) and along +y where z is up (Blender), so that x stays to the right; sideways scenes along +z.
_FORWARD = {"-y": (0, 0, 1), "y": (0, 0, -1), "z": (0, 1, 0), "-z": (0, -1, 0), "x": (0, 0, 1), "-x": (0, 0, 1)}


@dataclass(frozen=True)
class Up:
    """A direction that points up.

    axis: one of UP_AXES, or three numbers. source: who says so.
    """

    axis: str
    source: str

    def describe(self) -> str:
        """What was taken and why, for the user."""
        return f"{self.axis} is up ({self.source})"


def find_up(comments: Iterable[str]) -> Up | None:
    """What the header of a .ply says; the last word counts.

    Nerfstudio and others write "Vertical Axis: z" (an axis, which may have a sign), Brush "Vertical axis: y", or three
    numbers. Brush's y without a sign is what it writes of any scene, in the axes of its data, where y points down.
    """
    comments, found = list(comments), None
    from_brush = any("brush" in comment.lower() for comment in comments)
    for comment in comments:
        key, _, value = comment.lower().partition(":")
        value = value.strip().lstrip("+")
        if " ".join(key.split()) != _PREFIX:
            continue
        if from_brush and value == "y":
            found = Up("-y", "the file says Vertical axis: y, as Brush writes it of axes whose y points down")
        elif _direction(value) is not None:
            found = Up(value, "the file says so")
    return found


def _known_direction(up: str) -> np.ndarray:
    """The unit vector [3]. Raises InputError where the words say none."""
    direction = _direction(up) if isinstance(up, str) else None
    if direction is None:
        raise InputError(f"up: expected one of {', '.join(UP_AXES)}, or three numbers, got {shown(up)}")
    return direction


def upright_rotation(up: str) -> np.ndarray:
    """World-to-camera rotation [3, 3] of an upright camera before the scene: rows right, down, forward. See UP_AXES."""
    direction = _known_direction(up)
    nearest = up if up in UP_AXES else _nearest(direction)
    down, forward = -_known_direction(nearest), np.array(_FORWARD[nearest], np.float64)
    return np.stack([np.cross(down, forward), down, forward]) @ _shortest_turn(direction, -down) + 0.0  # no minus zeros


def _direction(words: str) -> np.ndarray | None:
    """The unit vector [3]; None where the words say none."""
    if words in UP_AXES:
        return (-1.0 if words[0] == "-" else 1.0) * np.eye(3)["xyz".index(words[-1])]
    parts = words.replace(",", " ").strip("[] ").split()
    try:
        vector = np.array([float(part) for part in parts])
    except ValueError:
        return None
    length = float(np.linalg.norm(vector))
    return vector / length if len(vector) == 3 and 1e-6 < length < math.inf else None


def _nearest(direction: np.ndarray) -> str:
    axis = int(np.abs(direction).argmax())
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def _shortest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The rotation [3, 3] that takes one unit vector to another that is not opposite, by the smallest angle."""
    x, y, z = np.cross(start, end)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + start @ end)
