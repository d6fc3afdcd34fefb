"""The views of one object, whatever layout they are stored in, and the checks that all layouts share.

Conventions: camera-to-world matrices, OpenCV axes (x right, y down, z forward), column vectors; focal lengths and
principal points in pixels, from the outer corner of the first pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.pinhole import is_orthonormal

IMAGE_SUFFIXES = (".png", ".webp", ".jpg", ".jpeg")


@dataclass(frozen=True)
class ObjectViews:
    """V views of one object, all of one size.

    image_paths: V files. camera_to_world: [V,4,4] float64. intrinsics: [V,4] float64, (fx, fy, cx, cy) in pixels of a
    width_px x height_px image, as stored (an Exif orientation is not applied). size_field: where that size is said.
    mask_paths: V files, where there are masks. distortion: [V,6] float64, as in lens.py, of the stored images; those
    that are read have none. None: none.
    """

    name: str
    image_paths: tuple[Path, ...]
    camera_to_world: np.ndarray
    intrinsics: np.ndarray
    width_px: int
    height_px: int
    size_field: str
    mask_paths: tuple[Path, ...] | None = None
    distortion: np.ndarray | None = None


def check_pose(where: str, pose: np.ndarray) -> None:
    """Raise InputError, beginning with `where`, unless a 4x4 matrix is a proper rigid motion."""
    if not np.isfinite(pose).all() or not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        raise InputError(
            f"{where}: bad pose: expected finite numbers and a last row of 0 0 0 1, got {pose[3].tolist()}"
        )
    rotation = pose[:3, :3]
    if not is_orthonormal(rotation):
        raise InputError(f"{where}: bad pose: the upper left 3x3 block is no rotation (its rows are not orthonormal)")
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where}: wrong handedness: the rotation mirrors (determinant -1); expected right-handed "
            "axes: negate the axis that was flipped"
        )


def check_intrinsics(where: str, intrinsics: np.ndarray, width_px: float, height_px: float) -> None:
    """Raise InputError, beginning with `where`, unless (fx, fy, cx, cy) and an image size make a pinhole camera."""
    fx, fy, cx, cy = intrinsics
    if not (np.isfinite([*intrinsics, width_px, height_px]).all() and min(fx, fy) > 0):
        raise InputError(f"{where}: bad intrinsics: expected a positive focal length in pixels, got {fx:g}, {fy:g}")
    if min(width_px, height_px) < 1 or width_px != int(width_px) or height_px != int(height_px):
        raise InputError(
            f"{where}: bad intrinsics: expected a whole width and height, got {width_px:g} x {height_px:g}"
        )
    if not (0 <= cx <= width_px and 0 <= cy <= height_px):
        raise InputError(
            f"{where}: bad intrinsics: principal point ({cx:g}, {cy:g}) lies outside the "
            f"{width_px:g} x {height_px:g} image"
        )


def point_looked_at(camera_to_world: np.ndarray) -> np.ndarray:
    """The point [3] nearest to all optical axes (least squares; the mean camera distance where they are parallel)."""
    positions, directions = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return np.linalg.lstsq(across.sum(0), (across @ positions[:, :, None]).sum(0)[:, 0], rcond=1e-6)[0]


def depths_of_object(camera_to_world: np.ndarray) -> np.ndarray:
    """Depth [V] of the point looked at before each camera, scene units; negative behind it."""
    towards = point_looked_at(camera_to_world) - camera_to_world[:, :3, 3]
    return (towards * camera_to_world[:, :3, 2]).sum(-1)


def check_looking_at_object(where: str, camera_to_world: np.ndarray, expected: str) -> None:
    """Raise InputError when the cameras look away from the point that their axes meet in.

    expected: the axes that the layout asks for, and how other ones are mended.
    """
    if len(camera_to_world) > 1 and (depths_of_object(camera_to_world) < 0).mean() > 0.5:
        raise InputError(f"{where}: wrong handedness: the cameras look away from the object; expected {expected}")
