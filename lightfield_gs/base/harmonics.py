"""The sphere: real harmonics, in which colours vary with the direction that a Gaussian is seen from, and rotations.

Signs and order of the harmonics as in 3D Gaussian splatting (Kerbl et al., 2023).
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch
from torch import Tensor

SH_COEFFICIENTS = (1, 4, 9, 16)  # (degree + 1)^2, degree 0..3
SH_CONSTANT = 0.28209479177387814  # the harmonic of degree 0, 1 / (2 sqrt(pi)): colour = 0.5 + constant * coefficient


def harmonics(directions: Tensor, count: int) -> Tensor:
    """Return the first `count` = K (1, 4, 9 or 16) real spherical harmonics [P,K] of unit directions [P,3]."""
    x, y, z = directions.unbind(-1)
    k0, k1, k20, k21, k22, k30, k31, k32, k33 = (
        float(np.sqrt(value / np.pi)) / 4 for value in (4, 12, 5, 60, 15, 7, 21 / 2, 105, 35 / 2)
    )
    basis = [torch.full_like(x, k0)]
    if count > 1:
        basis += [-k1 * y, k1 * z, -k1 * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis += [k21 * x * y, -k21 * y * z, k20 * (2 * zz - xx - yy), -k21 * x * z, k22 * (xx - yy)]
    if count > 9:
        basis += [
            -k33 * y * (3 * xx - yy),
            2 * k32 * x * y * z,
            -k31 * y * (4 * zz - xx - yy),
            k30 * z * (2 * zz - 3 * xx - 3 * yy),
            -k31 * x * (4 * zz - xx - yy),
            k32 * z * (xx - yy),
            -k33 * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, -1)


def rotations(quaternions: Tensor) -> Tensor:
    """Return rotation matrices [N,3,3] of quaternions [N,4] (wxyz, any length but zero)."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )
    return torch.stack(rows, -1).reshape(*quaternions.shape[:-1], 3, 3)


@functools.cache
def spiral(count: int) -> np.ndarray:
    """Return unit vectors [count, 3] spread evenly: a spiral with equal steps in height and the golden angle."""
    steps = np.arange(count)
    heights = 1 - (2 * steps + 1) / count
    angles = steps * math.pi * (3 - math.sqrt(5))
    radii = np.sqrt(1 - heights**2)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], 1)
