"""Filters over windows of pixels, half-size maps, and large images a strip at a time."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn import functional


def max_filter(values: Tensor, radius: int) -> Tensor:
    """Return the largest value of the window around each pixel, [H, W], on the values' device.

    The window doubles in each pass, which takes a third of the time of torch's max_pool2d on a CPU.

    Args:
        values: [H, W], floating point without NaN, or bool.
        radius: The window has 2 radius + 1 by 2 radius + 1 pixels; beyond the map there is nothing.
    """
    size = 2 * radius + 1
    least = 0 if values.dtype == torch.bool else -torch.inf
    for dim in (0, 1):
        padding = (0, 0, radius, radius) if dim == 0 else (radius, radius)
        values = functional.pad(values, padding, value=least)
        covered = 1
        while covered < size:
            step = min(covered, size - covered)
            count = values.shape[dim] - step
            values = torch.maximum(values.narrow(dim, 0, count), values.narrow(dim, step, count))
            covered += step
    return values


def box_sum(values: Tensor, radius: int) -> Tensor:
    """Return the sum over the window around each pixel, [H, W], on the values' device.

    Args:
        values: [H, W], floating point.
        radius: The window has 2 radius + 1 by 2 radius + 1 pixels; beyond the map there are zeros.
    """
    size, sums = 2 * radius + 1, values[None]
    for window, padding in (((size, 1), (radius, 0)), ((1, size), (0, radius))):
        sums = functional.avg_pool2d(sums, window, 1, padding, divisor_override=1)
    return sums[0]


def halve(values: Tensor) -> Tensor:
    """Return maps [C, H, W] at half their size, means of 2 x 2 pixels; at an odd end, of the pixels there are."""
    return functional.avg_pool2d(values[None], 2, 2, ceil_mode=True, count_include_pad=False)[0]


def row_strips(height: int, width: int, pixels: int) -> Iterator[tuple[int, int]]:
    """Yield ranges of rows (top, bottom), bottom exclusive, each of about this many pixels."""
    rows = max(1, pixels // width)
    return ((top, min(height, top + rows)) for top in range(0, height, rows))
