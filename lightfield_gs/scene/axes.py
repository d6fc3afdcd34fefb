"""The vertical axis of a scene, and upright cameras."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import UP_AXES

DEFAULT_UP = "-y"  # OpenCV axes: y points down
_PREFIX = "vertical axis"
# Viewing direction of an upright camera for each vertical axis, with x to the right. It is +z where y points down, -z
# where y points up (OpenGL), +y where z points up (Blender). Where x is vertical it is +z.
_FORWARD = {"-y": (0, 0, 1), "y": (0, 0, -1), "z": (0, 1, 0), "-z": (0, -1, 0), "x": (0, 0, 1), "-x": (0, 0, 1)}


@dataclass(frozen=True)
class Up:
    """The direction that points up.

    Attributes:
        axis: one of UP_AXES, or three numbers.
        source: where it is from, in words.
    """

    axis: str
    source: str

    def describe(self) -> str:
        """Describe the axis and its source for the user."""
        return f"{self.axis} is up ({self.source})"


def find_up(comments: Iterable[str]) -> Up | None:
    """Find the vertical axis in the header of a .ply; the last line counts, and None stands for no line.

    Nerfstudio and others write "Vertical Axis: z", an axis with or without a sign, or three numbers. Brush writes
    "Vertical axis: y" for all scenes; in the axes of its data y points down.
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


def _parse_direction(up: str) -> np.ndarray:
    """Parse a direction to a unit vector [3]; raise InputError for other words."""
    direction = _direction(up) if isinstance(up, str) else None
    if direction is None:
        raise InputError(f"up: expected one of {', '.join(UP_AXES)}, or three numbers, got {shown(up)}")
    return direction


def upright_rotation(up: str) -> np.ndarray:
    """Return the world-to-camera rotation [3, 3] of an upright camera before the scene.

    Args:
        up: one of UP_AXES, or three numbers.

    Returns:
        Rows right, down, forward.
    """
    direction = _parse_direction(up)
    nearest = up if up in UP_AXES else _nearest(direction)
    down, forward = -_parse_direction(nearest), np.array(_FORWARD[nearest], np.float64)
    return (
        np.stack([np.cross(down, forward), down, forward]) @ _shortest_rotation(direction, -down) + 0.0
    )  # no minus zeros


def orbit_rotation(yaw_deg: float, pitch_deg: float) -> np.ndarray:
    """Return the rotation [3, 3] of a camera's axes that goes round what it looks at, with a level horizon.

    Args:
        yaw_deg: To the right, about the camera's vertical axis.
        pitch_deg: Up, about its horizontal axis.
    """
    yaw, pitch = math.radians(yaw_deg), math.radians(pitch_deg)
    about_y = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]])
    return about_x @ about_y


def _direction(words: str) -> np.ndarray | None:
    """Parse a direction to a unit vector [3]; return None for other words."""
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


def _shortest_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotation [3, 3] of one unit vector to another, which must not be opposite."""
    x, y, z = np.cross(start, end)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + start @ end)
