"""The motion of cameras whose shutters roll, as the native projection takes it (csrc/math/rolling_shutter.h)."""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs.base.options import RollingShutter

# Those that the core has; the others are the same with the two poses exchanged
_READS: dict[RollingShutter, int] = {
    "none": 0,
    "top_to_bottom": 1,
    "bottom_to_top": 1,
    "left_to_right": 2,
    "right_to_left": 2,
}
_REVERSED = ("bottom_to_top", "right_to_left")


def shutter_number(shutter: RollingShutter) -> int:
    """Return the number of a shutter in the core (csrc/scene/camera.h)."""
    return _READS[shutter]


def moving_poses(first: Tensor, last: Tensor, shutter: RollingShutter) -> Tensor:
    """Return poses with their motion during the readout, [..., 6, 4], differentiable in both poses.

    The rows are those of the pose at the first row (or column), then the turn and the way to the last, each with a
    0 behind. Both are vectors in the axes of the camera at the first row; the turn is a rotation vector in radians.

    Args:
        first: [..., 4, 4], poses at the beginning of the readout, world to camera.
        last: likewise at its end.
        shutter: a rolling one.
    """
    if shutter in _REVERSED:
        first, last = last, first
    start, end = first.double(), last.double()
    between = end[..., :3, :3] @ start[..., :3, :3].mT
    # the centres are -R^T t, so their difference in the axes of the first pose is t - between^T t'
    way = start[..., :3, 3:] - between.mT @ end[..., :3, 3:]
    motion = torch.stack([rotation_vector(between), way.squeeze(-1)], -2)
    return torch.cat([first, torch.nn.functional.pad(motion, (0, 1)).to(first.dtype)], -2)


def rotation_vector(rotations: Tensor) -> Tensor:
    """Return axis times angle, radians, [..., 3], of rotations [..., 3, 3] by less than half a turn."""
    sines = torch.stack(
        [
            rotations[..., 2, 1] - rotations[..., 1, 2],
            rotations[..., 0, 2] - rotations[..., 2, 0],
            rotations[..., 1, 0] - rotations[..., 0, 1],
        ],
        -1,
    )
    sines = sines / 2
    square = sines.square().sum(-1, keepdim=True)
    cosine = ((rotations.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).unsqueeze(-1)
    small = (square < 1e-6) & (cosine > 0)  # there the root has no derivative
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    series = 1 + square / 6 + 3 * square.square() / 40 + 5 * square**3 / 112
    return sines * torch.where(small, series, torch.atan2(sine, cosine) / sine)
