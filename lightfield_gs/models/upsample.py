"""Fields on the grid of pixels: blurred, and refined along surfaces but not across their edges."""

from __future__ import annotations

import itertools
import math

import torch
import torch.nn.functional as F
from torch import Tensor

# Neighbours up to this many footprints nearer or farther are of the same surface; from twice as many on, of another.
SAME_SURFACE = 3.0


def blurred(channels: Tensor, deviation: float) -> Tensor:
    """channels [B,C,H,W] convolved with a Gaussian of this standard deviation in pixels, zeros beyond the edges."""
    reach = math.ceil(3 * deviation)
    places = torch.arange(-reach, reach + 1, dtype=channels.dtype, device=channels.device)
    weights = torch.exp(-0.5 * (places / deviation).square())
    weights = (weights / weights.sum()).view(1, 1, 1, -1)
    each = channels.flatten(0, 1)[:, None]
    each = F.conv2d(each, weights, padding=(0, reach))
    each = F.conv2d(each, weights.transpose(2, 3), padding=(reach, 0))
    return each[:, 0].view_as(channels)


def minmod(one: Tensor, other: Tensor) -> Tensor:
    """The smaller of two steps where both go the same way, else 0."""
    return torch.where(one * other > 0, torch.where(one.abs() < other.abs(), one, other), 0.0)


def along_surface(channels: Tensor, disparity: Tensor, footprint: Tensor, factor: int) -> Tensor:
    """channels [B,C,H,W] at [B,C,factor*H,factor*W]: bilinear between pixels of one surface.

    disparity [B,1,H,W] and footprint [B,1,1,1] (width of a pixel at depth 1) tell which pixels are of one surface:
    neighbours whose depths differ by three footprints at most count in full, from six on not at all.
    """
    if factor == 1:
        return channels
    fields = torch.cat([channels, disparity.log() / footprint], 1)
    around = {at: _shifted(fields, *at) for at in itertools.product((-1, 0, 1), repeat=2)}
    middle = fields[:, -1:]
    near = {at: (2 - (field[:, -1:] - middle).abs() / SAME_SURFACE).clamp(0, 1) for at, field in around.items()}
    rows = []
    for row in range(factor):
        # Every texel lies between its own pixel and three others, towards its corner of the pixel
        side_y, part_y = _between(row, factor)
        texels = []
        for column in range(factor):
            side_x, part_x = _between(column, factor)
            weights = {
                (y, x): share_y * share_x * near[y, x]
                for y, share_y in ((0, 1 - part_y), (side_y, part_y))
                for x, share_x in ((0, 1 - part_x), (side_x, part_x))
            }
            shares = torch.stack(list(weights.values()))
            values = torch.stack([around[at][:, :-1] for at in weights])
            texels.append((shares * values).sum(0) / shares.sum(0))
        rows.append(torch.stack(texels, -1))
    return torch.stack(rows, 3).flatten(4, 5).flatten(2, 3)


def _between(index: int, factor: int) -> tuple[int, float]:
    """For a texel of a pixel: towards which neighbour it lies, -1 or 1, and that neighbour's share."""
    place = (index + 0.5) / factor - 0.5
    return (1 if place > 0 else -1), abs(place)


def _shifted(fields: Tensor, down: int, right: int) -> Tensor:
    """fields [B,C,H,W] of the pixels so far down and to the right, 1 at most; beyond the edges those of the edge."""
    height, width = fields.shape[2:]
    padded = F.pad(fields, (1, 1, 1, 1), mode="replicate")
    return padded[:, :, 1 + down : 1 + down + height, 1 + right : 1 + right + width]
