"""A viewer's adjustments of a scene on the panel: focus, depth, cone, zoom and pan."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.visibility import depth_at
from lightfield_gs.scene.axes import orbit_rotation
from lightfield_gs.scene.gaussians import Gaussians

MOST_AMOUNT = 2.0  # of depth, in depths of the rig
ZOOMS = (0.01, 100.0)
MOST_PAN = 10.0  # panels
CONES_DEG = (0.0, 179.0)


@dataclass(frozen=True)
class Look:
    """Changes of a rig; the defaults change nothing.

    The view with offset s shows a point at view-space z = Z at (docs/design.md, "Where the cameras stand")
        u(s) = fx X/Z + cx + d(s),    d(s) = s fx (1/Z0 - 1/Z),    |s| <= Z0 tan(cone/2)

    Attributes:
        focus: View-space z of the panel's plane, > 0, scene units; or a point (x, y) of the picture, whose surface
            comes to lie in the plane. The point is 0..1 of the panel's width from the left and of its height from the
            top, after zoom and pan. None: as in the rig. Only Z0 changes, so that the centre view stays the same
            picture. The outermost views have d = +-fx tan(cone/2) (1 - Z0/Z), which is 0 at the focus.
        depth_amount: Factor a of all disparities, 0 (flat: all views alike) to 2; 1: as in the rig. tan(cone/2), and so
            all offsets s and all d(s), become a times as large.
        cone_deg: Full angle of the fan seen from the zero plane, 0..179, before depth_amount; None: as in the rig.
        zoom: Factor of the picture's size about the panel's centre, 0.01..100. Focal lengths f become zoom f, and c
            becomes W/2 + zoom (c - W/2). Disparities grow with the picture.
        pan: (x, y), movement of the zoomed picture to the right and down, in widths and heights of the panel. c becomes
            c + pan W.

    Raises:
        InputError: A value is out of its range.
    """

    focus: float | tuple[float, float] | None = None
    depth_amount: float = 1.0
    cone_deg: float | None = None
    zoom: float = 1.0
    pan: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        self._set("focus", _focus(self.focus))
        self._set("depth_amount", real_number("look: depth_amount", self.depth_amount, 0, MOST_AMOUNT))
        if self.cone_deg is not None:
            self._set("cone_deg", real_number("look: cone_deg", self.cone_deg, *CONES_DEG))
        self._set("zoom", real_number("look: zoom", self.zoom, *ZOOMS))
        if not is_row(self.pan, 2):
            raise InputError(f"look: pan must be two numbers, got {shown(self.pan)}")
        self._set("pan", tuple(real_number("look: pan", part, -MOST_PAN, MOST_PAN) for part in self.pan))

    def _set(self, key: str, value: object) -> None:
        object.__setattr__(self, key, value)

    def applied(self, rig: Rig, panel: Panel, gaussians: Gaussians | None = None) -> Rig:
        """Return a changed copy of the rig.

        Args:
            rig: The rig to change.
            panel: Its panel.
            gaussians: Scene in the rig's coordinates; needed if the focus is a point of the picture.

        Raises:
            InputError: An argument is invalid, or nothing is to be seen at the focus.
        """
        expect("rig", rig, Rig)
        expect("panel", panel, Panel)
        sizes = panel.width_px, panel.height_px
        fx, fy = rig.focal_px
        cx, cy = (
            size / 2 + self.zoom * (centre - size / 2) + pan * size
            for size, centre, pan in zip(sizes, rig.principal_point_px, self.pan)
        )
        moved = replace(rig, focal_px=(self.zoom * fx, self.zoom * fy), principal_point_px=(cx, cy))
        return replace(moved, zero_depth=self._zero_depth(moved, panel, gaussians), cone_deg=self._cone_deg(rig, panel))

    def _cone_deg(self, rig: Rig, panel: Panel) -> float | None:
        """Return 2 atan(a tan(cone/2)); None where nothing changes, so that the panel's cone stays in force."""
        if self.cone_deg is None and self.depth_amount == 1:
            return rig.cone_deg
        current = panel.cone_deg if rig.cone_deg is None else rig.cone_deg
        cone = current if self.cone_deg is None else self.cone_deg
        if self.depth_amount == 1:
            return cone
        return math.degrees(2 * math.atan(self.depth_amount * math.tan(math.radians(cone) / 2)))

    def _zero_depth(self, rig: Rig, panel: Panel, gaussians: Gaussians | None) -> float:
        if self.focus is None:
            return rig.zero_depth
        if isinstance(self.focus, float):
            return self.focus
        if gaussians is None:
            raise InputError("look: a focus that is a point of the picture needs the Gaussians; give them, or a depth")
        return depth_at(gaussians, panel, rig, self.focus)


def _focus(focus: object) -> float | tuple[float, float] | None:
    if focus is None:
        return None
    if is_row(focus):
        if not is_row(focus, 2):
            raise InputError(f"look: focus must be a depth, or x and y of a point of the picture, got {shown(focus)}")
        x, y = (real_number("look: focus, x and y,", part, 0, 1) for part in focus)  # type: ignore[attr-defined]
        return x, y
    return real_number("look: focus", focus, 1e-6, 1e12)


def orbited(rig: Rig, yaw_deg: float, pitch_deg: float) -> Rig:
    """Return the rig with its cameras turned around the point of the zero plane on the centre camera's axis.

    The horizon stays level. Both angles count from the given rig, so that no turn adds to another.

    Args:
        yaw_deg: To the right, about the camera's vertical axis.
        pitch_deg: Up, about its horizontal axis.
    """
    pivot = np.array([0.0, 0.0, rig.zero_depth])
    turn = np.eye(4)
    turn[:3, :3] = orbit_rotation(yaw_deg, pitch_deg)
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return replace(rig, world_to_camera=turn @ rig.world_to_camera)
