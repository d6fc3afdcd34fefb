"""The camera in the middle of many: the photograph that most others are near."""

from __future__ import annotations

import math

import numpy as np

_LEAST_SPREAD_DEG = 3.0  # of axes; below it their intersection is too uncertain
_IN_FRONT = 0.9  # the fraction of cameras that must have the intersection before them
FEWEST = 3  # least number of cameras that tell where their axes meet


def axes_intersection(centres: np.ndarray, axes: np.ndarray) -> np.ndarray | None:
    """Return the point [3] of least squared distance to the axes of cameras.

    Args:
        centres: [C,3], of the cameras.
        axes: [C,3], of length 1.

    Returns:
        None where the axes are fewer than three or nearly parallel, or the point is not before nine of ten cameras.
    """
    if len(centres) < FEWEST:
        return None
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    mean = across.mean(0)
    if np.linalg.eigvalsh(mean)[0] < math.sin(math.radians(_LEAST_SPREAD_DEG)) ** 2:
        return None
    point = np.linalg.solve(mean, (across @ centres[..., None]).mean(0)[:, 0])
    return point if (((point - centres) * axes).sum(1) > 0).mean() >= _IN_FRONT else None


def directions_from(centres: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """Return [C,3] of length 1, from the pivot to the cameras."""
    away = centres - pivot
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-300)


def angles_from(directions: np.ndarray, index: int) -> np.ndarray:
    """Return [C], degrees, the angles of directions from direction `index`; exact near 0, unlike an arc cosine."""
    cosines = directions @ directions[index]
    sines = np.linalg.norm(np.cross(directions, directions[index]), axis=1)
    return np.degrees(np.arctan2(sines, cosines))


def most_central(directions: np.ndarray, half_deg: float) -> tuple[int, int]:
    """Return the photograph with the most others within this angle, and their number.

    Among equals the least mean square of their angles decides.

    Args:
        directions: [C,3], of length 1, from what they show to the cameras.
        half_deg: the angle.
    """
    counts, spreads = [], []
    for index in range(len(directions)):
        angles = angles_from(directions, index)
        inside = angles <= half_deg
        counts.append(int(inside.sum()) - 1)
        spreads.append(float(np.square(angles[inside]).mean().round(9)))
    best = min(range(len(counts)), key=lambda index: (-counts[index], spreads[index]))
    return best, counts[best]
