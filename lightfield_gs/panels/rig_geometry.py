"""The off-axis fan of cameras behind a panel's views (Shi et al. 2025), with the plane z = zero_depth shared by all."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from lightfield_gs.base.checks import (
    check_fields,
    checked_field,
    expect,
    is_row,
    number_pair,
    real_number,
    shown,
    whole_number,
)
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.scene.cameras import Cameras

_MARGIN = 0.15  # fraction of the image beyond each edge within the limits: the "frustum + 30 %" of Gaussian splatting


Geometry = TypeVar("Geometry", bound="RigGeometry")


@dataclass(eq=False)
class RigGeometry:
    """The centre camera and the fan of a `Rig`, which lists the fields and their ranges."""

    world_to_camera: np.ndarray
    focal_px: tuple[float, float] = checked_field(number_pair, 1e-3, 1e9)
    principal_point_px: tuple[float, float] = checked_field(number_pair, -1e9, 1e9)
    zero_depth: float = checked_field(real_number, 1e-6, 1e12)
    cone_deg: float | None = checked_field(real_number, 0, 179.999, default=None)

    def __post_init__(self) -> None:
        self.world_to_camera = _rigid(self.world_to_camera)
        check_fields(self, "rig: ")

    def relative_to(self: Geometry, origin: Sequence[float]) -> Geometry:
        """Return the same cameras for coordinates relative to `origin`, three numbers in scene units.

        rig.relative_to(gaussians.origin) turns a rig in a file's coordinates into the rig of its Gaussians with that
        origin; the negated origin goes back. Double precision.
        """
        if not any(origin):
            return self
        matrix = self.world_to_camera.copy()
        matrix[:3, 3] += matrix[:3, :3] @ np.asarray(origin, np.float64)
        return replace(self, world_to_camera=matrix)

    # The fan

    def half_width(self, panel: Panel) -> float:
        """Return the largest offset of the fan's cameras, zero_depth * tan(cone / 2), scene units."""
        cone_deg = panel.cone_deg if self.cone_deg is None else self.cone_deg
        return self.zero_depth * math.tan(math.radians(cone_deg) / 2)

    def offset(self, x: float | np.ndarray, panel: Panel) -> float | np.ndarray:
        """Return the offset s of view x in [0, N], scene units to the right of the centre camera.

        s(x) = 2 Z0 tan(cone/2) (1/2 - x/N): view 0 goes to the right-most eye; mirrored by panel.invert_views. An
        integer view n is at x = n + 1/2.
        """
        sign = -1.0 if panel.invert_views else 1.0
        return sign * 2 * self.half_width(panel) * (0.5 - x / panel.views)

    def offset_range(self, panel: Panel) -> tuple[float, float]:
        """Return the smallest and the largest offset over x in [0, N]."""
        return -self.half_width(panel), self.half_width(panel)

    def jacobian_limits(self, panel: Panel) -> tuple[float, float, float, float]:
        """Return (lo_x, hi_x, lo_y, hi_y), the limits of X/Z and Y/Z in the projection's Jacobian, centre camera.

        They are the panel's frustum and 15 % of the image beyond each edge. In x the fan's largest offset over
        zero_depth widens them, so that all views share one set of limits.
        """
        (fx, fy), (cx, cy) = self.focal_px, self.principal_point_px
        width, height = panel.width_px, panel.height_px
        widen = self.half_width(panel) / self.zero_depth
        return (
            -(cx + _MARGIN * width) / fx - widen,
            (width - cx + _MARGIN * width) / fx + widen,
            -(cy + _MARGIN * height) / fy,
            (height - cy + _MARGIN * height) / fy,
        )

    def cameras(self, panel: Panel, views: Sequence[int] | None = None) -> Cameras:
        """Return the cameras of integer views, float64, in their order: at x = n + 1/2.

        Args:
            panel: The panel.
            views: Integers in 0..N-1; None: all N.

        Raises:
            InputError: A view is outside 0..N-1.
        """
        expect("panel", panel, Panel)
        if views is None:
            return self.cameras_at(panel, np.arange(panel.views) + 0.5)
        if not is_row(views):
            raise InputError(f"views must be whole numbers in a row, got {shown(views)}")
        numbers = np.array([whole_number("views", view, -1 << 31, 1 << 31) for view in views], np.int64)
        if numbers.size and not (0 <= numbers.min() and numbers.max() < panel.views):
            raise InputError(f"views must be 0..{panel.views - 1}, got {numbers.min()}..{numbers.max()}")
        return self.cameras_at(panel, numbers + 0.5)

    def cameras_at(self, panel: Panel, x: Sequence[float] | np.ndarray) -> Cameras:
        """Return the cameras at view coordinates, float64, in their order.

        They share the rotation; translation t_x - s and principal point cx + fx s / Z0 leave z = zero_depth without
        parallax.

        Args:
            panel: The panel.
            x: View coordinates in [0, N].

        Raises:
            InputError: A coordinate is outside 0..N.
        """
        import torch

        from lightfield_gs.scene.cameras import Cameras

        expect("panel", panel, Panel)
        positions = _float64(x)
        if positions is None or positions.ndim != 1 or not ((positions >= 0) & (positions <= panel.views)).all():
            raise InputError(f"x must be a row of numbers in 0..{panel.views}, got {shown(x)}")
        offsets = cast(np.ndarray, self.offset(positions, panel))
        poses, focals, centres, limits = (
            np.repeat(np.asarray(one, np.float64)[None], len(offsets), 0)
            for one in (self.world_to_camera, self.focal_px, self.principal_point_px, (*self.jacobian_limits(panel), 0))
        )
        poses[:, 0, 3] -= offsets
        centres[:, 0] += self.focal_px[0] / self.zero_depth * offsets
        limits[:, 4] = offsets
        return Cameras(
            torch.from_numpy(poses),
            torch.from_numpy(focals),
            torch.from_numpy(centres),
            panel.width_px,
            panel.height_px,
            jacobian_limits=torch.from_numpy(limits),
        )


def reduced(panel: Panel, rig: Geometry, width_px: int) -> tuple[Panel, Geometry]:
    """Return the same view of the scene on a panel of another width; a panel is never enlarged."""
    scale = min(1.0, width_px / panel.width_px)
    width, height = max(1, round(panel.width_px * scale)), max(1, round(panel.height_px * scale))
    scales = width / panel.width_px, height / panel.height_px
    (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
    focal, centre = (fx * scales[0], fy * scales[1]), (cx * scales[0], cy * scales[1])
    return replace(panel, width_px=width, height_px=height), replace(rig, focal_px=focal, principal_point_px=centre)


def _float64(values: Any) -> np.ndarray | None:
    """Return a copy of `values` as a float64 array; None where they are no real numbers."""
    try:
        array = np.asarray(values)
        return None if array.dtype.kind in "cSU" else np.array(array, np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        return None


def _rigid(given: Any) -> np.ndarray:
    """Return a matrix as float64 [4, 4] with a proper rotation; raise InputError for any other."""
    matrix = _float64(given)
    if matrix is None or matrix.shape != (4, 4):
        came = shown(given) if matrix is None else f"shape {list(matrix.shape)}"
        raise InputError(f"rig: world_to_camera must be 4 rows of 4 numbers, got {came}")
    if not np.isfinite(matrix).all():
        raise InputError("rig: world_to_camera has numbers that are not finite")
    if not np.abs(matrix[3] - (0, 0, 0, 1)).max() <= 1e-6:
        raise InputError(f"rig: the last row of world_to_camera must be 0 0 0 1, got {matrix[3].tolist()}")
    rotation = matrix[:3, :3]
    if not np.abs(rotation @ rotation.T - np.eye(3)).max() <= 1e-4 or np.linalg.det(rotation) < 0:
        raise InputError(
            "rig: world_to_camera must begin with a rotation (orthonormal, determinant +1); "
            "scale, shear or mirroring is not allowed"
        )
    return matrix
