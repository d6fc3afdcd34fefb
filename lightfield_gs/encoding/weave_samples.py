"""Colours of views at the places of a panel's sub-pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.encoding.weave_places import Window

# Places are rounded to so many parts of a pixel, so that where sizes agree they fall on pixels, whatever the rounding
_PARTS = 65536.0


def reduced_picture(picture: Tensor, window: Window) -> Tensor:
    """A view [h, w, 3] at the window's view_px, averaged where that is smaller; the same type."""
    width, height = window.view_px
    if tuple(picture.shape[:2]) == (height, width):
        return picture
    floats = picture.permute(2, 0, 1)[None].to(torch.float32)
    small = torch.nn.functional.interpolate(floats, (height, width), mode="bilinear", antialias=True)[0]
    small = small.permute(1, 2, 0)
    if picture.dtype == torch.float32:
        return small.contiguous()
    return small.round_().to(torch.int32).to(picture.dtype).contiguous()


@dataclass(frozen=True)
class Taps:
    """The two pixels beside each place along one side of a picture, which are mixed.

    first, second: int64 [V, S], offsets in the samples of a picture; weight: of the second, float32 [V, S]; inside:
    whether the view reaches there, bool [V, S]. V: the views, or 1 where all are alike; S: the panel's columns or rows.
    mixes: whether any weight is above 0.
    """

    first: Tensor
    second: Tensor
    weight: Tensor
    inside: Tensor
    mixes: bool


def taps_across(window: Window, count: int, device: str) -> Taps:
    """Of the panel's columns, in each of `count` views, which a shift moves; else in all of them alike."""
    places = _places(window.left, window.width, window.panel_px[0], device)[None]
    if window.shift:
        views = (torch.arange(count, dtype=torch.float64, device=device) + 0.5) / count - 0.5
        places = places - window.shift * views[:, None]
    return _taps(places, window.view_px[0], 3, window.low_x, window.high_x)


def taps_down(window: Window, device: str) -> Taps:
    """Of the panel's rows."""
    places = _places(window.top, window.height, window.panel_px[1], device)[None]
    return _taps(places, window.view_px[1], 3 * window.view_px[0], window.low_y, window.high_y)


def _places(start: float, length: float, size: int, device: str) -> Tensor:
    """Centres of the panel's pixels in shares of a view, float64 [size]."""
    return start + (torch.arange(size, dtype=torch.float64, device=device) + 0.5) * (length / size)


def _taps(places: Tensor, size: int, stride: int, least: float, most: float) -> Taps:
    inside = (places >= least - 1 / _PARTS) & (places <= most + 1 / _PARTS)
    pixels = (((places * size - 0.5) * _PARTS).round() / _PARTS).clamp(0, size - 1)
    first = pixels.floor()
    weight = (pixels - first).float()
    first = first.to(torch.int64)
    second = (first + 1).clamp_max(size - 1)
    return Taps(first * stride, second * stride, weight, inside, bool((weight > 0).any()))


def sampled(stack: Tensor, slot: Tensor, view: Tensor, rows: slice, across: Taps, down: Taps) -> tuple[Tensor, Tensor]:
    """Colours float32 [R, W, 3] at some rows of the panel, in the scale of the stack, and whether the view reaches
    there, bool, which broadcasts to that.

    stack: [G, h, w, 3]; slot: int64 [R, W, 3], which of it each sub-pixel takes; view: its number among all views.
    """
    flat = stack.view(-1)
    pixels = stack[0].numel()
    low = slot * pixels + torch.arange(3, device=stack.device)
    columns = None
    if len(across.first) > 1:
        columns = view * across.first.shape[1] + torch.arange(view.shape[1], device=stack.device)[:, None]
    first, weight, inside = (_along(part, columns) for part in (across.first, across.weight, across.inside))
    second = _along(across.second, columns) if across.mixes else first

    def line(start: Tensor) -> Tensor:
        values = _taken(flat, start + first)
        return values.lerp_(_taken(flat, start + second), weight.expand_as(values)) if across.mixes else values

    values = line(low + down.first[0, rows, None, None])
    if down.mixes:
        lower = line(low + down.second[0, rows, None, None])
        values.lerp_(lower, down.weight[0, rows, None, None].expand_as(values))
    return values, inside & down.inside[0, rows, None, None]


def _along(table: Tensor, columns: Tensor | None) -> Tensor:
    """A table of taps [V, W] for sub-pixels [R, W, 3]; columns: where each is in it, None where all views are alike."""
    return table[0][:, None] if columns is None else table.view(-1)[columns]


def _taken(flat: Tensor, index: Tensor) -> Tensor:
    """flat[index] as float32; torch takes no uint16 at an index."""
    if flat.dtype == torch.uint16:
        return (flat.view(torch.int16)[index].to(torch.int32) & 0xFFFF).float()
    return flat[index].float()
