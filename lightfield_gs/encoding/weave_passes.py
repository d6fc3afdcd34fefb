"""The passes of `weave` over a panel, each for some of the views: on the CPU in native code, on CUDA in torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.encoding.weave_fan import Fan
from lightfield_gs.encoding.weave_places import Window
from lightfield_gs.encoding.weave_samples import Taps, sampled, taps_across, taps_down

_NATIVE = {torch.uint8: _core.weave_uint8, torch.uint16: _core.weave_uint16, torch.float32: _core.weave_float32}


class Held(NamedTuple):
    """Views that are held: pictures [G, h, w, 3] from number `first` on. The sub-pixels whose first view is one of the
    first `own` of them are drawn in this pass."""

    pictures: Tensor
    first: int
    own: int


class NativePasses:
    """On the CPU."""

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
        """Draws into the panel's image [H, W, 3] what the views reach."""
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
    """The same in torch, for CUDA: chunks of rows, each sub-pixel gathered from its views."""

    def __init__(self, fan: Fan, window: Window, device: str):
        self._fan, self._device = fan, device
        self._taps = taps_across(window, fan.count, device), taps_down(window, device)

    def draw(self, out: Tensor, held: Held) -> None:
        """Draws into the panel's image [H, W, 3] what the views reach."""
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
    """The means float32 [R, W, 3] of the views that reach some rows, and whether any does."""
    value = torch.zeros_like(at, dtype=torch.float32)
    total = torch.zeros_like(value)
    for k in range(fan.most_mixed):
        view = (first + k).clamp_max(fan.count - 1)
        weight = _share(fan, at, view) * (first + k < fan.count)
        slot = (view - held.first).clamp(0, len(held.pictures) - 1)
        colour, inside = sampled(held.pictures, slot, view, rows, *taps)
        weight = weight * inside
        total += weight
        mixed = value.lerp(colour, weight / total.clamp_min(torch.finfo(torch.float32).tiny))
        value = torch.where(total == weight, torch.where(weight > 0, colour, value), mixed)
    return value, total > 0


def _share(fan: Fan, at: Tensor, view: Tensor) -> Tensor:
    """How much of the box around each place is a view's, float32."""
    if fan.box == 0:
        return torch.ones_like(at, dtype=torch.float32)
    low, high = at - fan.box / 2, at + fan.box / 2
    start = torch.where(view == 0, low, torch.maximum(low, view - 0.5))
    end = torch.where(view == fan.count - 1, high, torch.minimum(high, view + 0.5))
    return ((end - start).clamp_min(0) / fan.box).float()


def stored(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Colours as they are stored, in the scale of the type; integers are rounded, ties to even."""
    if dtype == torch.float32:
        return values.to(dtype)
    return values.round().clamp(0, full_scale(dtype)).to(torch.int32).to(dtype)


def full_scale(dtype: torch.dtype) -> float:
    """The number that stands for 1."""
    return {torch.uint8: 255.0, torch.uint16: 65535.0}.get(dtype, 1.0)
