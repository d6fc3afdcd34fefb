"""The rig behind a panel's views: its cameras, an off-axis fan (Shi et al. 2025).

The plane z = zero_depth is the same in all views. lightfield_gs.panels.stored_rigs has rigs in files.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

import lightfield_gs
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
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.captures.camera_files import FileCamera
from lightfield_gs.io.text_files import read_mapping, write_mapping
from lightfield_gs.panels.panel import Panel, panel_lens
from lightfield_gs.rasterizer.lenticular_camera import PINHOLE, Aperture, LenticularCamera
from lightfield_gs.scene.axes import DEFAULT_UP, orbit_rotation, upright_rotation

if TYPE_CHECKING:
    from lightfield_gs import NotebookPicture
    from lightfield_gs.scene.cameras import Cameras
    from lightfield_gs.scene.gaussians import Gaussians

_MARGIN = 0.15  # fraction of the image beyond each edge within the limits: the "frustum + 30 %" of Gaussian splatting
RIG_KEYS = ("world_to_camera", "focal_px", "principal_point_px", "zero_depth")
RIG_OPTIONAL = ("cone_deg",)
SIZE_KEY = "size_px"  # of the panel that the rig of a file is for
# Of a file beside a scene whose format has no place for them: how the scene was drawn
SCENE_KEYS = ("background", "antialiased")


@dataclass(eq=False)
class Rig:
    """The cameras of the views: a fan on the x-axis of its centre camera, all with the same rotation.

    Rig.frame makes a rig that shows a scene on a panel.

    Attributes:
        world_to_camera: [4, 4] float64, [R|t] over 0 0 0 1, OpenCV axes (x right, y down, z forward), column vectors.
        focal_px: (fx, fy), > 0, at the panel's resolution.
        principal_point_px: (cx, cy) at the panel's resolution, from the outer corner of the first pixel.
        zero_depth: View-space z, > 0, scene units, of the plane without parallax: the panel itself.
        cone_deg: Full angle of the fan seen from the zero plane, in [0, 180), 0 being a flat picture; None: the
            panel's.

    Raises:
        InputError: A value is out of its range.
    """

    world_to_camera: np.ndarray
    focal_px: tuple[float, float] = checked_field(number_pair, 1e-3, 1e9)
    principal_point_px: tuple[float, float] = checked_field(number_pair, -1e9, 1e9)
    zero_depth: float = checked_field(real_number, 1e-6, 1e12)
    cone_deg: float | None = checked_field(real_number, 0, 179.999, default=None)

    def __post_init__(self) -> None:
        self.world_to_camera = _rigid(self.world_to_camera)
        check_fields(self, "rig: ")

    @staticmethod
    def frame(
        gaussians: Gaussians,
        panel: Panel,
        world_to_camera: np.ndarray | None = None,
        *,
        up: str = DEFAULT_UP,
        turn_deg: float = 0.0,
        tilt_deg: float = 0.0,
        notes: list[str] | None = None,
    ) -> Rig:
        """Return a rig that shows a scene on the panel: the whole scene, or its subject.

        The content is the area that the visible Gaussians cover. The outermost 0.01 % of their opacity on each side is
        left out, or 0.1 % or 1 % where it lies far out. The content is centred. It fills 92 % of the panel's height, or
        of its width if that is the limit; the panel takes 90 degrees at most. The zero plane is at the harmonic mean of
        near and far; 5 % of the opacity lies beyond each of them.

        In three cases the content is only the subject (lightfield_gs.panels.content). A gap surrounds the densest part
        of the scene. The scene surrounds a small dense part. A hull that is closed on all sides has something in it.

        A new camera looks at the content from in front. The content's height takes the angle that the panel subtends
        for its viewer, kept within 20..50 degrees, or 30 if unknown. The camera goes nearer if something is in between.
        If a given camera sees nothing near the harmonic mean, the zero plane is at the depth in the middle of the
        picture.

        Args:
            gaussians: One set.
            panel: The panel.
            world_to_camera: [4, 4], the camera's pose; None: a new camera.
            up: The axis that points up for a new camera, one of axes.UP_AXES, or three numbers. With -y, as in OpenCV
                axes, the camera looks along +z.
            turn_deg: Degrees that a new camera goes to the right round the content; find_front tells a good number.
            tilt_deg: Degrees that it goes up.
            notes: A list to append a line to for each assumption.

        Raises:
            InputError: `gaussians` is a batch or empty, or none lies in front of the camera.
        """
        from lightfield_gs.panels.framing import fit_scene

        turn = orbit_rotation(turn_deg, tilt_deg) @ upright_rotation(up)
        return fit_scene(_unfitted(), gaussians, panel, world_to_camera, turn, notes)

    @staticmethod
    def from_yaml(path: str | Path, panel: Panel | None = None) -> Rig:
        """Return a rig from a YAML file with the fields of this class; cone_deg may be missing.

        Args:
            path: The file.
            panel: The panel that it is for. A rig that the file says to be for another size is fitted to it. None: the
                rig as it is stored.

        Raises:
            InputError: The file cannot be read.
        """
        data = read_mapping(path, RIG_KEYS, (*RIG_OPTIONAL, SIZE_KEY, *SCENE_KEYS))
        size = data.pop(SIZE_KEY, None)
        with named(path):
            rig = Rig(**{key: value for key, value in data.items() if key not in SCENE_KEYS})
            return rig if size is None or panel is None else rig.fitted(checked_size(size), panel)

    def fitted(self, size_px: tuple[int, int], panel: Panel) -> Rig:
        """Return the rig of a panel of another size for this one, whose middle shows all of that picture."""
        width, height = size_px
        if (width, height) == (panel.width_px, panel.height_px):
            return self
        camera = FileCamera("", self.world_to_camera, self.focal_px, self.principal_point_px, width, height)
        focal, centre = camera.fitted(panel.width_px, panel.height_px)
        return replace(self, focal_px=focal, principal_point_px=centre)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as from_yaml reads them."""
        fields = {
            "world_to_camera": self.world_to_camera.tolist(),
            "focal_px": list(self.focal_px),
            "principal_point_px": list(self.principal_point_px),
            "zero_depth": self.zero_depth,
        }
        return fields if self.cone_deg is None else {**fields, "cone_deg": self.cone_deg}

    def to_yaml(self, path: str | Path, panel: Panel | None = None) -> None:
        """Write the rig as from_yaml reads it, every digit kept, atomically.

        Args:
            path: The file.
            panel: The panel that it is for, whose size is then stored.
        """
        size = {} if panel is None else {SIZE_KEY: [panel.width_px, panel.height_px]}
        write_mapping(path, {**self.to_dict(), **size})

    def relative_to(self, origin: Sequence[float]) -> Rig:
        """Return the same cameras for coordinates relative to `origin`, three numbers in scene units.

        rig.relative_to(gaussians.origin) turns a rig in a file's coordinates into the rig of its Gaussians with that
        origin; the negated origin goes back. Double precision.
        """
        if not any(origin):
            return self
        matrix = self.world_to_camera.copy()
        matrix[:3, 3] += matrix[:3, :3] @ np.asarray(origin, np.float64)
        return replace(self, world_to_camera=matrix)

    def _repr_html_(self) -> str:
        """Return the picture that a notebook shows."""
        return lightfield_gs.NotebookPicture.of_rig(self)._repr_html_()

    def show(self, panel: Panel | None = None) -> NotebookPicture:
        """Return a drawing of the fan of cameras and the zero plane that turns with the pointer, in a notebook.

        Args:
            panel: The panel that the rig is for, which says the cone where the rig does not.
        """
        return lightfield_gs.NotebookPicture.of_rig(self, panel, lightfield_gs.NotebookPicture.FRAMES)

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
        size = panel.width_px, panel.height_px
        return edge_slopes(self.focal_px, self.principal_point_px, size, self.half_width(panel) / self.zero_depth)

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

    def reduced(self, panel: Panel, width_px: int) -> tuple[Panel, Rig]:
        """Return the same view of the scene on a panel of another width; a panel is never enlarged."""
        scale = min(1.0, width_px / panel.width_px)
        width, height = max(1, round(panel.width_px * scale)), max(1, round(panel.height_px * scale))
        scales = width / panel.width_px, height / panel.height_px
        (fx, fy), (cx, cy) = self.focal_px, self.principal_point_px
        focal, centre = (fx * scales[0], fy * scales[1]), (cx * scales[0], cy * scales[1])
        return replace(panel, width_px=width, height_px=height), replace(
            self, focal_px=focal, principal_point_px=centre
        )


def edge_slopes(focal_px: Any, principal_point_px: Any, size_px: tuple[int, int], widen: Any) -> tuple:
    """Return the numbers of Rig.jacobian_limits, of floats or of tensors.

    Args:
        focal_px: fx, fy.
        principal_point_px: cx, cy.
        size_px: Width and height of the panel.
        widen: Added to the limits of X/Z.
    """
    (fx, fy), (cx, cy), (width, height) = focal_px, principal_point_px, size_px
    return (
        -(cx + _MARGIN * width) / fx - widen,
        (width - cx + _MARGIN * width) / fx + widen,
        -(cy + _MARGIN * height) / fy,
        (height - cy + _MARGIN * height) / fy,
    )


def checked_size(size: Any) -> tuple[int, int]:
    """Return the width and height of a panel; raise InputError for other values."""
    if not is_row(size, 2):
        raise InputError(f"{SIZE_KEY}: expected width and height of a panel in pixels, got {shown(size)}")
    width, height = (whole_number(SIZE_KEY, side, 1, 1 << 20) for side in size)
    return width, height


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


# The cameras as values of the rasterizer


def view_aperture(panel: Panel, rig: Rig, view_filter: float) -> Aperture:
    """Return the aperture of each camera of a rig for encode's view_filter: a box of that many views."""
    step = 2 * rig.half_width(panel) / panel.views
    return Aperture(view_filter * step / math.sqrt(12), float(rig.zero_depth)) if view_filter > 0 else PINHOLE


def lenticular_camera(panel: Panel, rig: Rig, continuous: bool = False, view_filter: float = 0.0) -> LenticularCamera:
    """Return the cameras and the lens by which the sub-pixels of a panel see a scene.

    Args:
        panel: The panel.
        rig: Its rig.
        continuous: See panel_lens.
        view_filter: See encode.
    """
    start, end = float(rig.offset(0, panel)), float(rig.offset(panel.views, panel))
    pose = np.asarray(rig.world_to_camera, np.float64).reshape(-1).tolist()
    optics = (float(v) for v in (*rig.focal_px, *rig.principal_point_px))
    limits = (*(float(v) for v in rig.jacobian_limits(panel)), 0.0)
    aperture = view_aperture(panel, rig, view_filter).deviation
    lens = panel_lens(panel, continuous, start, (end - start) / panel.views)
    return LenticularCamera(tuple(pose), tuple(optics), limits, float(rig.zero_depth), lens, aperture)


# Rigs of photos


def frame_photo(gaussians: Gaussians, panel: Panel) -> Rig:
    """Return the rig of a photo's Gaussians, which are in the axes of its camera. It shows all Gaussians, however wide.

    Raises:
        InputError: As in Rig.frame.
    """
    from lightfield_gs.panels.content import photo_extent
    from lightfield_gs.panels.framing import checked_scene

    return frame_extent(photo_extent(checked_scene(gaussians, panel)).tolist(), panel)


def frame_extent(extent: Sequence[float], panel: Panel) -> Rig:
    """Return the rig whose views all show the content of a photo_extent; raise InputError if it has no weight."""
    from lightfield_gs.panels.framing import fit_all_views

    return fit_all_views(_unfitted(), extent, panel)


def _unfitted() -> Rig:
    """Return a rig at the origin that is yet to be fitted to a scene."""
    return Rig(np.eye(4), (1.0, 1.0), (0.0, 0.0), 1.0)
