"""The camera of a transforms.json, as NeRF and its successors write it: what its readers share.

Source: Mildenhall et al., "NeRF", ECCV 2020; Müller et al., "Instant Neural Graphics Primitives", 2022; nerfstudio's
data conventions for camera_model and the lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume

TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # axes of a camera: from x right, y up, z backward (OpenGL)
MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")  # but for a known lens


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation that is nearest to a matrix [3,3] that nearly is one: files store few digits."""
    left, _, right = np.linalg.svd(matrix)
    return left @ right


def unscaled(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """A matrix [3,3] without the one scale that its rows all have, and that; 1, and the matrix itself, where it is a
    rotation already or nothing that a scale makes one."""
    scale = float(np.linalg.norm(matrix)) / math.sqrt(3)
    if is_orthonormal(matrix) or not 1e-9 < scale < 1e9 or not is_orthonormal(matrix / scale):
        return matrix, 1.0
    return matrix / scale, scale


def say_scales(path: str | Path, scales: Sequence[float]) -> None:
    """Says what rotations of a file of cameras were divided by; nothing where all are rotations."""
    if scaled := [scale for scale in scales if scale != 1]:
        assume(
            f"{path}: the rotations of {len(scaled)} of {len(scales)} cameras are scaled, the first by "
            f"{scaled[0]:.6g}: they are divided by it, and the places of the cameras stay as they are"
        )


def is_orthonormal(matrix: np.ndarray) -> bool:
    """Whether the rows of a matrix [3,3] are, up to the few digits that files have."""
    return bool(np.abs(matrix).max() <= 2 and np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-3))


def focal_lengths(
    number: Callable[[str], float | None], width_px: float, height_px: float
) -> tuple[float, float] | None:
    """(fx, fy) in pixels, of fl_x and fl_y or else camera_angle_x and camera_angle_y, radians; the one that is missing
    equals the other: square pixels. None where there is neither.

    number: the value of a key, or None where the file does not say it; of an angle within (0, pi).
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
