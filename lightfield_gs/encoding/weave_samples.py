"""Colours of views at the places of a panel's sub-pixels."""

from __future__ import annotations

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


def sampled(
    stack: Tensor, slot: Tensor, view: Tensor, row: Tensor, column: Tensor, channel: Tensor, window: Window, count: int
) -> tuple[Tensor, Tensor]:
    """Colours float64 [S] at pixels of the panel, in the scale of the stack, and whether the view reaches there.

    stack: [G, h, w, 3]; slot: which of it; view: its number among all `count`, which decides how far it is shifted;
    row, column: of the panel; channel: 0..2. All int64 [S].
    """
    height, width = stack.shape[1:3]
    x = window.left + (column.double() + 0.5) * (window.width / window.panel_px[0])
    if window.shift:
        x = x - window.shift * ((view.double() + 0.5) / count - 0.5)
    y = window.top + (row.double() + 0.5) * (window.height / window.panel_px[1])
    slack = 1 / _PARTS
    inside = (x >= window.low_x - slack) & (x <= window.high_x + slack)
    inside &= (y >= window.low_y - slack) & (y <= window.high_y + slack)
    (x0, x1, across), (y0, y1, down) = _taps(x, width), _taps(y, height)
    flat, first = stack.view(-1), slot * (height * width * 3) + channel

    def at(y: Tensor, x: Tensor) -> Tensor:
        return _taken(flat, first + (y * width + x) * 3)

    values = at(y0, x0)
    if bool((across > 0).any()):
        values = values + (at(y0, x1) - values) * across
    if bool((down > 0).any()):
        lower = at(y1, x0)
        lower = lower + (at(y1, x1) - lower) * across
        values = values + (lower - values) * down
    return values, inside


def _taps(share: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """The two pixels beside a place in shares of a picture's side, and the weight of the second."""
    place = ((share * size - 0.5) * _PARTS).round() / _PARTS
    place = place.clamp(0, size - 1)
    low = place.floor()
    first = low.to(torch.int64)
    return first, (first + 1).clamp_max(size - 1), place - low


def _taken(flat: Tensor, index: Tensor) -> Tensor:
    """flat[index] as float64. torch has no indexing of uint16 on every device."""
    if flat.dtype == torch.uint16:
        return (flat.view(torch.int16)[index].to(torch.int32) & 0xFFFF).double()
    return flat[index].double()
