"""Gaussians in the nodes of a scene graph: affine maps of their centres, covariances and harmonics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lightfield_gs.base.harmonics import rotations
from lightfield_gs.io.scenes.scene_arrays import Fields, Origin, checked_fields, concatenate_fields, relative_centres
from lightfield_gs.scene.rotation import harmonics_rotation, rotated_quaternions, rotation_quaternions

_SIMILAR = 1e-5  # relative difference of the factors along three axes, below which a map keeps shapes
_WHOLE = 1e-9  # distance to whole numbers, by which maps of harmonics are off for exact turns
_AT_ONCE = 1 << 16  # Gaussians


def gather_placed(
    path: Path, parts: list[Fields], is_moved: bool, skip_invalid: bool
) -> tuple[Fields, Origin, list[str]]:
    """Return the fields of all placed parts of a file, their origin, and notes on them.

    Args:
        path: the file, for messages.
        parts: see place.
        is_moved: whether any part is translated, so that the centres may be far from zero.
        skip_invalid: leave invalid Gaussians out.

    Raises:
        InputError: see checked_fields.
    """
    fields, origin = concatenate_fields(parts), (0.0, 0.0, 0.0)
    if is_moved:
        fields["means"], origin = relative_centres(fields["means"], fields["scales"])
    fields, notes = checked_fields(path, fields, skip_invalid)
    return fields, origin, notes


@np.errstate(invalid="ignore", over="ignore")
def place(fields: Fields, matrix: np.ndarray) -> Fields:
    """Map Gaussians by an affine matrix.

    A map that scales the axes unequally, or shears, changes each covariance; its polar factor turns the harmonics.

    Args:
        fields: the five fields of N Gaussians.
        matrix: float64 [4, 4], with the last row 0, 0, 0, 1; it may mirror.

    Returns:
        New fields; the centres are float64, and the others are shared where the map keeps them.
    """
    linear = matrix[:3, :3]
    means = fields["means"].astype(np.float64) @ linear.T + matrix[:3, 3]
    if np.array_equal(linear, np.eye(3)):
        return {**fields, "means": means}
    left, factors, right = np.linalg.svd(linear)
    turn = left @ right
    turn = np.where(abs(turn - np.rint(turn)) < _WHOLE, np.rint(turn), turn)
    if np.ptp(factors) <= _SIMILAR * factors.max():
        shapes = _turn_quaternions(fields["quaternions"], turn), fields["scales"] * np.float32(factors.mean())
    else:
        shapes = _deform(fields["quaternions"], fields["scales"], linear)
    quaternions, scales = shapes
    sh = _turn_harmonics(fields["sh"], turn)
    return {**fields, "means": means, "quaternions": quaternions, "scales": scales, "sh": sh}


def _turn_quaternions(quaternions: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Turn quaternions [N, 4] by an orthogonal matrix [3, 3]; a mirrored covariance is also the one of -turn."""
    turn = turn * np.sign(np.linalg.det(turn))
    if np.array_equal(np.abs(turn), np.eye(3)):  # the axes of an ellipsoid have no sign
        return quaternions * np.append(1.0, turn.diagonal()).astype(quaternions.dtype)
    return rotated_quaternions(torch.from_numpy(turn), torch.from_numpy(quaternions)).numpy()


def _deform(quaternions: np.ndarray, scales: np.ndarray, linear: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternions and scales of covariances that are mapped by any matrix [3, 3]."""
    deformed = np.empty_like(quaternions), np.empty_like(scales)
    for start in range(0, len(scales), _AT_ONCE):
        rows = slice(start, start + _AT_ONCE)
        axes = rotations(torch.from_numpy(quaternions[rows]).double()).numpy() * scales[rows, None].astype(np.float64)
        axes = linear @ axes
        invalid = ~np.isfinite(axes).all((1, 2))
        axes[invalid] = 0.0
        turns, factors, _ = np.linalg.svd(axes)
        turns[np.linalg.det(turns) < 0] *= -1
        factors[invalid] = np.nan
        deformed[0][rows] = rotation_quaternions(torch.from_numpy(turns)).numpy()
        deformed[1][rows] = factors
    return deformed


def _turn_harmonics(sh: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Turn harmonics [N, K, 3] by an orthogonal matrix [3, 3]."""
    count = sh.shape[1]
    if count == 1:
        return sh
    change = harmonics_rotation(torch.from_numpy(turn), count).numpy()
    change = np.where(abs(change - np.rint(change)) < _WHOLE, np.rint(change), change).astype(sh.dtype)
    rows = sh.reshape(len(sh), -1)
    if np.array_equal(change, np.diag(change.diagonal())):
        return (rows * change.diagonal().repeat(3)).reshape(sh.shape)
    return (rows @ np.kron(change, np.eye(3, dtype=sh.dtype)).T).reshape(sh.shape)
