"""Pinhole cameras and their poses: conversions and checks that the readers of all layouts share.

Source of the transforms.json fields: Mildenhall et al., "NeRF", ECCV 2020. Müller et al., "Instant Neural Graphics
Primitives", 2022. nerfstudio's data conventions for camera_model and the lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError

TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # axes of a camera: from x right, y up, z backward (OpenGL)
# Values of camera_model that are a pinhole but for Brown's distortion
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a matrix [3,3] that nearly is one: files store few digits."""
    left, _, right = np.linalg.svd(matrix)
    return left @ right


def remove_scale(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """Divide a matrix [3,3] by its uniform scale; return the rotation and the scale.

    A rotation, and a matrix that no scale makes one, come back as they are, with 1.
    """
    scale = float(np.linalg.norm(matrix)) / math.sqrt(3)
    if is_orthonormal(matrix) or not 1e-9 < scale < 1e9 or not is_orthonormal(matrix / scale):
        return matrix, 1.0
    return matrix / scale, scale


def note_scales(path: str | Path, scales: Sequence[float]) -> None:
    """Note the scales that rotations of a file of cameras were divided by; nothing where all are 1."""
    if scaled := [scale for scale in scales if scale != 1]:
        assume(
            f"{path}: the rotations of {len(scaled)} of {len(scales)} cameras are scaled, the first by "
            f"{scaled[0]:.6g}: they are divided by it, and the places of the cameras stay as they are"
        )


def is_orthonormal(matrix: np.ndarray) -> bool:
    """Return whether the rows of a matrix [3,3] are orthonormal, up to the few digits of files."""
    return bool(np.abs(matrix).max() <= 2 and np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3))


def focal_lengths(
    number: Callable[[str], float | None], width_px: float, height_px: float
) -> tuple[float, float] | None:
    """Return (fx, fy) in pixels from fl_x and fl_y, or else from camera_angle_x and camera_angle_y.

    Args:
        number: returns the value of a key, or None where the file does not have it; angles within (0, pi) radians.
        width_px, height_px: size of the image.

    Returns:
        (fx, fy); a missing one equals the other (square pixels). None where both are missing.
    """
    found = []
    for length_key, angle_key, size in (("fl_x", "camera_angle_x", width_px), ("fl_y", "camera_angle_y", height_px)):
        length = number(length_key)
        if length is None and (angle := number(angle_key)) is not None:
            length = size / 2 / math.tan(angle / 2)
        found.append(length)
    fx, fy = found
    if fx is None:
        return None if fy is None else (fy, fy)
    return fx, (fx if fy is None else fy)


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
    """Raise InputError unless the numbers make a pinhole camera.

    Args:
        where: the file and field, at the start of the message.
        intrinsics: (fx, fy, cx, cy) in pixels.
        width_px, height_px: size of the image.
    """
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


def pose_matrix(quaternion: Sequence[float], translation: Sequence[float]) -> np.ndarray | None:
    """Return a pose as a matrix.

    Args:
        quaternion: w, x, y, z, of any length but 0.
        translation: x, y, z.

    Returns:
        [4,4] float64; None where the numbers make no pose.
    """
    numbers = np.array([*quaternion, *translation], np.float64)
    if not (np.abs(numbers) < 1e12).all() or (length := np.linalg.norm(numbers[:4])) <= 1e-9:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_matrix(numbers[:4] / length), numbers[4:]
    return pose


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation [3,3] of a unit quaternion w, x, y, z: v + 2 w (q x v) + 2 q x (q x v)."""
    w, (x, y, z) = quaternion[0], quaternion[1:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
