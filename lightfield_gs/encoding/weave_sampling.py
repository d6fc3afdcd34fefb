"""Colours of views at the sub-pixels of a panel: on the CPU in native code, on CUDA in torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.encoding.weave_geometry import Fan, Window

# Places are rounded to this fraction of a pixel, so that where sizes agree they fall on pixels
_PARTS = 65536.0


def reduced_picture(picture: Tensor, window: Window) -> Tensor:
    """Return a view [h, w, 3] at the window's view_px, averaged where that is smaller; of the same type."""
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
    """The two pixels that are mixed for each position along one side of a picture.

    V is the number of views, or 1 where all are alike; S is the number of the panel's columns or rows.

    Attributes:
        first, second: int64 [V, S], offsets in the samples of a picture.
        weight: Weight of the second pixel, float32 [V, S].
        inside: Whether the view reaches there, bool [V, S].
        mixes: Whether any weight is above 0.
    """

    first: Tensor
    second: Tensor
    weight: Tensor
    inside: Tensor
    mixes: bool


def taps_across(window: Window, count: int, device: str) -> Taps:
    """Return the taps of the panel's columns: of each of `count` views if a shift moves them, else of all alike."""
    places = _places(window.left, window.width, window.panel_px[0], device)[None]
    if window.shift:
        views = (torch.arange(count, dtype=torch.float64, device=device) + 0.5) / count - 0.5
        places = places - window.shift * views[:, None]
    return _taps(places, window.view_px[0], 3, window.low_x, window.high_x)


def taps_down(window: Window, device: str) -> Taps:
    """Return the taps of the panel's rows."""
    places = _places(window.top, window.height, window.panel_px[1], device)[None]
    return _taps(places, window.view_px[1], 3 * window.view_px[0], window.low_y, window.high_y)


def _places(start: float, length: float, size: int, device: str) -> Tensor:
    """Return the centres of the panel's pixels in fractions of a view, float64 [size]."""
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
    """Return colours float32 [R, W, 3] at rows of the panel, in the scale of the stack, and whether the view reaches.

    Args:
        stack: [G, h, w, 3].
        slot: int64 [R, W, 3], the index of a sub-pixel's picture in the stack.
        view: int64 [R, W, 3], its number among all views.
        rows: of the panel.
        across: taps of the columns.
        down: taps of the rows.

    Returns:
        The colours; and bool, which broadcasts to them.
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
    """Return taps [V, W] for sub-pixels [R, W, 3].

    Args:
        columns: Index of each column; None: all views are alike.
    """
    return table[0][:, None] if columns is None else table.view(-1)[columns]


def _taken(flat: Tensor, index: Tensor) -> Tensor:
    """Return flat[index] as float32; torch takes no uint16 at an index."""
    if flat.dtype == torch.uint16:
        return (flat.view(torch.int16)[index].to(torch.int32) & 0xFFFF).float()
    return flat[index].float()


_NATIVE = {torch.uint8: _core.weave_uint8, torch.uint16: _core.weave_uint16, torch.float32: _core.weave_float32}


class Held(NamedTuple):
    """Views in memory: pictures [G, h, w, 3] from number `first` on.

    Attributes:
        own: This pass draws the sub-pixels whose first view is among the first `own` pictures.
    """

    pictures: Tensor
    first: int
    own: int


class NativePasses:
    """Passes over the panel in native code, on the CPU."""

    def __init__(self, fan: Fan, window: Window):
        self._places = np.ascontiguousarray(fan.places())  # which the native fan points into
        self._fan = fan.native(self._places)
        w = window
        self._window = _core.WeaveWindow(
            left=w.left,
            top=w.top,
            width=w.width,
            height=w.height,
            low_x=w.low_x,
            low_y=w.low_y,
            high_x=w.high_x,
            high_y=w.high_y,
            shift=w.shift,
        )

    def draw(self, out: Tensor, held: Held) -> None:
        """Draw the views in memory into the panel's image [H, W, 3]."""
        count, height, width, _ = held.pictures.shape
        _NATIVE[out.dtype](
            held.pictures.data_ptr(),
            held.first,
            held.own,
            count,
            height,
            width,
            self._window,
            self._fan,
            out.data_ptr(),
            torch.get_num_threads(),
        )


class TorchPasses:
    """Passes over the panel in torch, for CUDA: chunks of rows, each sub-pixel gathered from its views."""

    def __init__(self, fan: Fan, window: Window, device: str):
        self._fan, self._device = fan, device
        self._taps = taps_across(window, fan.count, device), taps_down(window, device)

    def draw(self, out: Tensor, held: Held) -> None:
        """Draw the views in memory into the panel's image [H, W, 3]."""
        bits = torch.int16 if out.dtype == torch.uint16 else out.dtype  # torch selects no uint16
        for rows, places in self._fan.rows():
            at = torch.from_numpy(places).to(self._device)
            first = (at - self._fan.box / 2 + 0.5).floor().clamp_(0, self._fan.count - 1).to(torch.int64)
            mine = (at >= 0) & (first >= held.first) & (first < held.first + held.own)
            values, reached = _mixed(held, at, first, rows, self._fan, self._taps)
            drawn = out[rows].view(bits)
            drawn.copy_(torch.where(mine & reached, stored(values, out.dtype).view(bits), drawn))


def _mixed(
    held: Held, at: Tensor, first: Tensor, rows: slice, fan: Fan, taps: tuple[Taps, Taps]
) -> tuple[Tensor, Tensor]:
    """Return the means float32 [R, W, 3] of the views that reach some rows, and whether any does."""
    value = torch.zeros_like(at, dtype=torch.float32)
    total = torch.zeros_like(value)
    for k in range(fan.most_mixed):
        view = (first + k).clamp_max(fan.count - 1)
        weight = _weight(fan, at, view) * (first + k < fan.count)
        slot = (view - held.first).clamp(0, len(held.pictures) - 1)
        colour, inside = sampled(held.pictures, slot, view, rows, *taps)
        weight = weight * inside
        total += weight
        mixed = value.lerp(colour, weight / total.clamp_min(torch.finfo(torch.float32).tiny))
        value = torch.where(total == weight, torch.where(weight > 0, colour, value), mixed)
    return value, total > 0


def _weight(fan: Fan, at: Tensor, view: Tensor) -> Tensor:
    """Return the weight of a view, its part of the box around each place, float32."""
    if fan.box == 0:
        return torch.ones_like(at, dtype=torch.float32)
    low, high = at - fan.box / 2, at + fan.box / 2
    start = torch.where(view == 0, low, torch.maximum(low, view - 0.5))
    end = torch.where(view == fan.count - 1, high, torch.minimum(high, view + 0.5))
    return ((end - start).clamp_min(0) / fan.box).float()


def stored(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Convert colours, in the scale of the type, to the type; integers are rounded, ties to even."""
    if dtype == torch.float32:
        return values.to(dtype)
    return values.round().clamp(0, full_scale(dtype)).to(torch.int32).to(dtype)


def full_scale(dtype: torch.dtype) -> float:
    """Return the number that stands for 1."""
    return {torch.uint8: 255.0, torch.uint16: 65535.0}.get(dtype, 1.0)
