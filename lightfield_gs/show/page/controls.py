"""What the page asks for: where the viewer has turned the scene, how it lies in the panel, and where the eye is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import QUALITY_NAMES, QualityName
from lightfield_gs.panels.look import CONES_DEG, MOST_AMOUNT, MOST_PAN, ZOOMS, Look
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig

# Each number that the page may set, with its range
_RANGES = {
    "yaw_deg": (-180.0, 180.0),
    "pitch_deg": (-89.0, 89.0),
    "focus": (1e-6, 1e12),
    "depth_amount": (0.0, MOST_AMOUNT),
    "cone_deg": CONES_DEG,
    "zoom": ZOOMS,
    "pan_x": (-MOST_PAN, MOST_PAN),
    "pan_y": (-MOST_PAN, MOST_PAN),
    "eye": (-0.5, 0.5),
}


@dataclass(frozen=True)
class Controls:
    """The state of the page.

    yaw_deg, pitch_deg: how far the camera has gone to the right and up around the middle of what is shown, degrees.
    focus, depth_amount, cone_deg, zoom, pan_x, pan_y: see Look; focus is a depth here. None: as in the rig.
    eye: place of the eye across the viewing zone, -0.5 (left border) .. 0.5 (right border).
    quality: how much error is allowed for less time.
    """

    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    focus: float | None = None
    depth_amount: float = 1.0
    cone_deg: float | None = None
    zoom: float = 1.0
    pan_x: float = 0.0
    pan_y: float = 0.0
    eye: float = 0.0
    quality: QualityName = "exact"

    @staticmethod
    def of(query: Mapping[str, str]) -> Controls:
        """Controls from a query of the page; what is missing has its default, and other words are not looked at.

        Raises InputError on a value that is no number, or out of its range.
        """
        values: dict[str, Any] = {name: number(query, name, *_RANGES[name]) for name in _RANGES if name in query}
        if "quality" in query:
            if query["quality"] not in QUALITY_NAMES:
                raise InputError(f"quality must be {', '.join(QUALITY_NAMES)}, got {query['quality'][:40]!r}")
            values["quality"] = query["quality"]
        return Controls(**values)

    def picture(self) -> Controls:
        """What decides the native picture: all but the place of the eye."""
        return replace(self, eye=0.0)

    def look(self) -> Look:
        """What these controls change of a rig, but for the turn."""
        return Look(self.focus, self.depth_amount, self.cone_deg, self.zoom, (self.pan_x, self.pan_y))

    def rig(self, base: Rig, panel: Panel) -> Rig:
        """The rig that these controls make of the one that the scene was framed with."""
        return self.look().applied(orbited(base, self.yaw_deg, self.pitch_deg), panel)


def defaults() -> dict[str, Any]:
    """The fields of Controls and their defaults."""
    return {field.name: field.default for field in fields(Controls)}


def number(query: Mapping[str, str], name: str, low: float, high: float) -> float:
    """A number of the query in low..high. Raises InputError."""
    try:
        value = float(query[name])
    except KeyError:
        raise InputError(f"the query lacks {name}") from None
    except ValueError:
        raise InputError(f"{name} must be a number, got {query[name][:40]!r}") from None
    return real_number(name, value, low, high)


def orbited(rig: Rig, yaw_deg: float, pitch_deg: float) -> Rig:
    """The rig, its cameras gone around the point in the zero plane that lies on the axis of the centre camera.

    yaw_deg: to the right, about the camera's vertical axis; pitch_deg: up, about its horizontal axis. The horizon stays
    level: both count from the rig as it is, so that no turn adds to another.
    """
    yaw, pitch = math.radians(yaw_deg), math.radians(pitch_deg)
    about_y = np.array([[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)], [0, math.sin(pitch), math.cos(pitch)]])
    pivot = np.array([0.0, 0.0, rig.zero_depth])
    turn = np.eye(4)
    turn[:3, :3] = about_x @ about_y
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return replace(rig, world_to_camera=turn @ rig.world_to_camera)
