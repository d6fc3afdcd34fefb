"""Rotation of Gaussians about the origin: centres, axes and spherical harmonics."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_COEFFICIENTS, harmonics, rotations, spiral

Origin = tuple[float, float, float]
_DIRECTIONS = 64  # evenly spread, more than the 16 harmonics: values there determine the coefficients well
_TOLERANCE = 1e-4  # of orthonormality


def rotated_fields(
    means: Tensor, quaternions: Tensor, sh: Tensor, origin: Origin, rotation: Any
) -> tuple[Tensor, Tensor, Tensor, Origin]:
    """Rotate means, quaternions, harmonics and origin of Gaussians; see Gaussians.rotated."""
    matrix = rotation_matrix(rotation, means.device)
    rotated = matrix.detach().cpu() @ torch.tensor(origin, dtype=torch.float64)
    return (
        means @ matrix.T.to(means),
        rotated_quaternions(matrix, quaternions),
        harmonics_rotation(matrix, sh.shape[-2]).to(means) @ sh,
        tuple((rotated + 0.0).tolist()),
    )


def rotation_matrix(rotation: Any, device: torch.device | str = "cpu") -> Tensor:
    """Convert a rotation [3, 3] or quaternion [4] (wxyz, any length but zero) to float64 [3, 3]; raise InputError."""
    try:
        given = torch.as_tensor(rotation).to(device, torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(f"rotation: expected numbers [3, 3] or a quaternion [4], got {shown(rotation)}") from None
    if given.shape not in ((3, 3), (4,)) or given.is_complex():
        raise InputError(f"rotation: expected [3, 3] or a quaternion [4] (wxyz), got {list(given.shape)}")
    if not bool(torch.isfinite(given).all()):
        raise InputError(f"rotation: expected finite numbers, got {shown(given.tolist())}")
    if given.shape == (4,):
        if not bool(given.any()):
            raise InputError("rotation: expected a quaternion of any length but zero, got 0, 0, 0, 0")
        return rotations((given / given.abs().max())[None])[0]
    values = given.detach()  # torch warns of float() on tensors with gradients
    error = float((values @ values.T - torch.eye(3).to(values)).abs().max())
    if not error <= _TOLERANCE or float(torch.linalg.det(values)) < 0:
        raise InputError(
            "rotation: expected orthonormal rows and determinant +1 (no scale, shear or mirroring), got "
            f"{shown(given.tolist())}"
        )
    return given


def harmonics_rotation(rotation: Tensor, count: int) -> Tensor:
    """Return the matrix that rotates a function on the sphere by its coefficients of harmonics.

    The rotated function has in each direction d the value of the original in rotation^T d. Both are sums of harmonics
    of the same degree, so the coefficients follow exactly from values in enough directions (Wigner, 1931).

    Args:
        rotation: [3, 3].
        count: number of coefficients K: 1, 4, 9 or 16.

    Returns:
        float64 [K, K].
    """
    directions = torch.from_numpy(spiral(_DIRECTIONS)).to(rotation)
    before = harmonics(directions @ rotation, count)
    parts, first = [], 0
    for inverse, last in zip(_inverses(), SH_COEFFICIENTS):
        if last <= count:
            parts.append(torch.from_numpy(inverse).to(rotation) @ before[:, first:last])
            first = last
    return torch.block_diag(*parts)


@functools.cache
def _inverses() -> tuple[np.ndarray, ...]:
    """Return for degree 0..3 the matrix from values in the directions to coefficients, [2 degree + 1, M]."""
    values = harmonics(torch.from_numpy(spiral(_DIRECTIONS)), SH_COEFFICIENTS[-1]).numpy()
    return tuple(np.linalg.pinv(values[:, first:last]) for first, last in zip((0, *SH_COEFFICIENTS), SH_COEFFICIENTS))


def rotated_quaternions(rotation: Tensor, quaternions: Tensor) -> Tensor:
    """Rotate Gaussians with quaternions [..., N, 4] (wxyz) by a rotation [3, 3]."""
    return _product(rotation_quaternions(rotation).to(quaternions), quaternions)


def rotation_quaternions(matrices: Tensor) -> Tensor:
    """Convert rotations [..., 3, 3] to unit quaternions [..., 4] (wxyz), by the longest column of the outer product."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrices.unbind(-2))
    rows = (
        (1 + a + e + i, h - f, c - g, d - b),
        (h - f, 1 + a - e - i, b + d, c + g),
        (c - g, b + d, 1 - a + e - i, f + h),
        (d - b, c + g, f + h, 1 - a - e + i),
    )
    outer = torch.stack([torch.stack(row, -1) for row in rows], -2)
    longest = outer.detach().diagonal(dim1=-2, dim2=-1).argmax(-1)
    column = outer.gather(-2, longest[..., None, None].expand(*longest.shape, 1, 4))[..., 0, :]
    return column / column.norm(dim=-1, keepdim=True)


def _product(first: Tensor, others: Tensor) -> Tensor:
    """Multiply a quaternion [4] with each of others [..., 4] (Hamilton): rotate by the latter, then by the former."""
    w, x, y, z = first.unbind()
    rows = torch.stack(
        [
            torch.stack([w, -x, -y, -z]),
            torch.stack([x, w, -z, y]),
            torch.stack([y, z, w, -x]),
            torch.stack([z, -y, x, w]),
        ]
    )
    return others @ rows.T
