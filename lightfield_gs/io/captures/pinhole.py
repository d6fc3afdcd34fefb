"""The camera of a transforms.json, as NeRF and its successors write it: what its readers share.

Source: Mildenhall et al., "NeRF", ECCV 2020; Müller et al., "Instant Neural Graphics Primitives", 2022; nerfstudio's
data conventions for camera_model and the lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])  # axes of a camera: from x right, y up, z backward (OpenGL)
MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")  # but for a known lens


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation that is nearest to a matrix [3,3] that nearly is one: files store few digits."""
    left, _, right = np.linalg.svd(matrix)
    return left @ right


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
