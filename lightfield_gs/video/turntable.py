"""A rig that goes round the subject, in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig

MOST_FRAMES = 1_000_000
_FULL_TURN_DEG = 360.0


def pivot_of(rig: Rig, panel: Panel) -> np.ndarray:
    """The point [3] of the zero plane that is in the middle of the panel, in the camera's axes, scene units."""
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    slopes = (panel.width_px / 2 - cx) / fx, (panel.height_px / 2 - cy) / fy, 1.0
    return rig.zero_depth * np.array(slopes)


def turned(rig: Rig, panel: Panel, degrees: float, up: np.ndarray | None = None) -> Rig:
    """The rig, gone round what the middle of the panel shows by an angle; to the right where that is positive.

    up: direction [3] of the axis, in the scene's axes; None: the camera's own vertical. The axis goes through the point
    of the zero plane in the middle of the panel, which stays there. With Q the rotation about it (Rodrigues, 1840) and
    P the point, [R | t] becomes [R Q^T | t + R (P - Q^T P)]: at 0 and at 360 degrees that is the rig itself, to the
    bit. Raises InputError.
    """
    expect("rig", rig, Rig)
    expect("panel", panel, Panel)
    angle = math.radians(math.fmod(real_number("degrees", degrees, -1e9, 1e9), _FULL_TURN_DEG))
    rotation, move = rig.world_to_camera[:3, :3], rig.world_to_camera[:3, 3]
    x, y, z = _unit(-rotation[1] if up is None else up)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    back = np.eye(3) - math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    point = rotation.T @ (pivot_of(rig, panel) - move)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation @ back, move + rotation @ (point - back @ point)
    return replace(rig, world_to_camera=matrix)


def turntable(
    rig: Rig, panel: Panel, frames: int, degrees: float = _FULL_TURN_DEG, up: np.ndarray | None = None
) -> list[Rig]:
    """The rigs of a loop that begins with the rig itself: full turns, of 360 degrees or a multiple; or else a swing by
    `degrees` in all, to the right first, to the left and back. up: see `turned`. Raises InputError."""
    frames = whole_number("frames", frames, 1, MOST_FRAMES)
    degrees = real_number("degrees", degrees, -1e6, 1e6)
    if degrees % _FULL_TURN_DEG == 0:
        angles = [degrees * number / frames for number in range(frames)]
    else:
        angles = [degrees / 2 * math.sin(2 * math.pi * number / frames) for number in range(frames)]
    return [turned(rig, panel, angle, up) for angle in angles]


def _unit(direction: np.ndarray) -> np.ndarray:
    vector = np.asarray(direction, np.float64)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else 0.0
    if not 1e-12 < length < math.inf:
        raise InputError(f"up: expected three finite numbers, not all zero, got {vector.tolist()}")
    return vector / length
