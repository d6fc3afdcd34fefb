"""Where a depth map is torn: slopes that do not cross edges, and mixed pixels.

All depth maps here are [H, W], view-space z in scene units, NaN where nothing was measured.
"""

from __future__ import annotations

import torch
from torch import Tensor

# Neighbours belong to one surface up to this slope, depth per sideways length: tan 85 degrees. A steeper step is an
# edge between two surfaces, which opens by some 4 pixels over a cone of 40 degrees.
STEEPEST = 11.4
_SNAP_PASSES = 3  # each takes one pixel off both ends of a smoothed edge


def joined(depth: Tensor, focal_px: float, steepest: float = STEEPEST) -> Tensor:
    """Whether each pixel and its right neighbour belong to one surface, bool [H, W-1]."""
    left, right = depth[:, :-1], depth[:, 1:]
    return (right - left).abs() * focal_px <= steepest * torch.minimum(left, right)


def edges(depth: Tensor, focal_px: tuple[float, float]) -> Tensor:
    """Whether each pixel has a depth and another surface beside it, to the left, right, above or below, bool [H, W]."""
    there = torch.isfinite(depth)
    result = torch.zeros_like(there)
    for whole, mine, marked in (
        (joined(depth, focal_px[0]), there, result),
        (joined(depth.T, focal_px[1]), there.T, result.T),
    ):
        torn = ~whole & mine[:, 1:] & mine[:, :-1]
        marked[:, 1:] |= torn
        marked[:, :-1] |= torn
    return result


def slopes(depth: Tensor, focal_px: float, steepest: float = STEEPEST) -> Tensor:
    """Depth per sideways length from column to column, [H, W], dimensionless.

    The mean of the steps to those neighbours that belong to the surface, 0 where none does.
    """
    whole = joined(depth, focal_px, steepest)
    steps = torch.where(whole, depth[:, 1:] - depth[:, :-1], 0)
    both = [
        torch.nn.functional.pad(values, (1, 0)) + torch.nn.functional.pad(values, (0, 1))
        for values in (steps, whole.to(steps))
    ]
    return both[0] / both[1].clamp_min(1) * focal_px / depth


def snap_mixed(depth: Tensor, focal_px: tuple[float, float]) -> Tensor:
    """The depth map with its smoothed edges made sharp again, [H, W].

    A pixel on the way from one surface to another, with an edge to both sides along its row or column, lies on neither:
    it takes the depth of the neighbour that is nearer in disparity. Thin things, nearer or farther than both
    neighbours, stay.
    """
    for _ in range(_SNAP_PASSES):
        depth = _snap_columns(depth, focal_px[0])
        depth = _snap_columns(depth.T, focal_px[1]).T
    return depth


def _snap_columns(depth: Tensor, focal_px: float) -> Tensor:
    whole = joined(depth, focal_px)
    steps = (1 / depth).diff(dim=1)
    before, after = steps[:, :-1], steps[:, 1:]
    mixed = ~whole[:, :-1] & ~whole[:, 1:] & (before * after > 0)
    neighbour = torch.where(before.abs() <= after.abs(), depth[:, :-2], depth[:, 2:])
    snapped = depth.clone()
    snapped[:, 1:-1] = torch.where(mixed, neighbour, depth[:, 1:-1])
    return snapped
