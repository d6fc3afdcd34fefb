"""Where a depth map is torn: slopes that do not cross edges, mixed pixels, and what lies hidden behind an edge.

All depth maps here are [H, W], view-space z in scene units, NaN where nothing was measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# Neighbours belong to one surface up to this slope, depth per sideways length: tan 85 degrees. A steeper step is an
# edge between two surfaces, which opens by some 4 pixels over a cone of 40 degrees.
_STEEPEST = 11.4
_SNAP_PASSES = 3  # each takes one pixel off both ends of a smoothed edge
_FRINGE = 4  # pixels next to an edge that may have colours of its other side
_REACH = 0.25  # how far a surface goes on behind what stands before it, as a share of the image's width


def joined(depth: Tensor, focal_px: float) -> Tensor:
    """Whether each pixel and its right neighbour belong to one surface, bool [H, W-1]."""
    left, right = depth[:, :-1], depth[:, 1:]
    return (right - left).abs() * focal_px <= _STEEPEST * torch.minimum(left, right)


def slopes(depth: Tensor, focal_px: float) -> Tensor:
    """Depth per sideways length from column to column, [H, W], dimensionless.

    The mean of the steps to those neighbours that belong to the surface, 0 where none does.
    """
    whole = joined(depth, focal_px)
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


@dataclass(frozen=True)
class Continuation:
    """Stripes of hidden surface, M of them: each a pixel high, at the depth of the visible pixel that it continues.

    rows: [M] int64. columns: [M] int64 of the pixel that is continued. colour_columns: [M] int64 of the one whose
    colour it has. centres: [M] columns of the middles, pixels from the left edge of the image. widths: [M] pixels.
    """

    rows: Tensor
    columns: Tensor
    colour_columns: Tensor
    centres: Tensor
    widths: Tensor


def continue_behind(depth: Tensor, focal_px: float) -> Continuation:
    """The far surfaces go on along the rows behind the near ones, for the cameras beside that look past the edge.

    Stripes of 1, 2, 4, ... pixels follow each other from the edge on, up to a quarter of the width, as long as what
    stands before them is nearer than they are.
    """
    rightwards = _continue_rightwards(depth, joined(depth, focal_px))
    mirrored = _continue_rightwards(depth.flip(1), joined(depth, focal_px).flip(1))
    width = depth.shape[1]
    leftwards = (mirrored[0], *(width - 1 - columns for columns in mirrored[1:3]), width - mirrored[3], mirrored[4])
    return Continuation(*(torch.cat(pair) for pair in zip(rightwards, leftwards)))


def _continue_rightwards(depth: Tensor, whole: Tensor) -> tuple[Tensor, ...]:
    """The fields of Continuation for the far surfaces that lie to the left of an edge, and go on to its right."""
    width = depth.shape[1]
    rows, columns = (~whole & (depth[:, :-1] > depth[:, 1:])).nonzero().unbind(1)
    colour_columns = columns
    for _ in range(_FRINGE):
        inwards = (colour_columns - 1).clamp_min(0)
        colour_columns = torch.where(whole[rows, inwards], inwards, colour_columns)
    # The farthest depth over as many columns, from each one to the right, as the stripe is wide
    farthest = depth.nan_to_num(nan=torch.inf)
    stripes, size = [], 1
    while 2 * size - 1 <= _REACH * width:
        first = columns + size
        hidden = first + size <= width
        hidden &= farthest[rows, first.clamp_max(farthest.shape[1] - 1)] < depth[rows, columns]
        rows, columns, colour_columns = rows[hidden], columns[hidden], colour_columns[hidden]
        centres = (columns + 1.5 * size).to(depth)  # its pixels are columns + size ... columns + 2 size - 1
        stripes.append((rows, columns, colour_columns, centres, torch.full_like(centres, size)))
        farthest = torch.maximum(farthest[:, :-size], farthest[:, size:])
        size *= 2
    if not stripes:
        stripes = [(rows[:0], columns[:0], columns[:0], depth.new_zeros(0), depth.new_zeros(0))]
    return tuple(torch.cat(field) for field in zip(*stripes))
