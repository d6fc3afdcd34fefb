"""Filters over windows of pixels, half-size images, and large images a strip at a time."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn import functional


def largest(values: Tensor, radius: int) -> Tensor:
    """The largest value of the 2 radius + 1 by 2 radius + 1 pixels around each of a map [H, W] without NaN; of bool
    values whether any is true. Beyond the map there is nothing."""
    size = 2 * radius + 1
    least = 0 if values.dtype == torch.bool else -torch.inf
    for dim in (0, 1):
        padding = (0, 0, radius, radius) if dim == 0 else (radius, radius)
        values = functional.pad(values, padding, value=least)
        reached = 1
        while reached < size:
            step = min(reached, size - reached)
            count = values.shape[dim] - step
            values = torch.maximum(values.narrow(dim, 0, count), values.narrow(dim, step, count))
            reached += step
    return values


def total(values: Tensor, radius: int) -> Tensor:
    """The sum of the 2 radius + 1 by 2 radius + 1 pixels around each of a map [H, W]; beyond it there is nothing."""
    for dim in (0, 1):
        padding = (0, 0, radius, radius) if dim == 0 else (radius, radius)
        length, size, done = values.shape[dim], 2 * radius + 1, 0
        # Sums of 1, 2, 4, ... pixels, of which those make the whole that the size has in binary
        part, result = functional.pad(values, padding), torch.zeros_like(values)
        for power in (1 << bit for bit in range(size.bit_length())):
            if size & power:
                result = result + part.narrow(dim, done, length)
                done += power
            count = part.shape[dim] - power
            part = part.narrow(dim, 0, count) + part.narrow(dim, power, count) if 2 * power <= size else part
        values = result
    return values


def halved(values: Tensor) -> Tensor:
    """Means of 2 x 2 pixels of maps [C, H, W]; of those that there are, at an odd end."""
    return functional.avg_pool2d(values[None], 2, 2, ceil_mode=True, count_include_pad=False)[0]


def strips(height: int, width: int, pixels: int) -> Iterator[tuple[int, int]]:
    """Rows top .. bottom - 1 of about so many pixels, one after the other."""
    rows = max(1, pixels // width)
    return ((top, min(height, top + rows)) for top in range(0, height, rows))
