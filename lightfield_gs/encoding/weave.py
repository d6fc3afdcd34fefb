"""The views of a quilt, of a folder or of a light field to the image of a panel: interlacing views of any size and
number.

View q of M, counted from the left-most camera, stands at the place (q + 1/2) / M of the fan; a sub-pixel that shows
the panel's x of N views stands at 1 - x / N (with invert_views x / N). So integer views of a panel fall exactly on
those of a set of as many.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import dense_tensor
from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Views
from lightfield_gs.encoding.sorted_plan import checked_view_map
from lightfield_gs.encoding.weave_places import Fit, Window, window_of
from lightfield_gs.encoding.weave_samples import Taps, reduced_picture, sampled, taps_across, taps_down
from lightfield_gs.panels.panel import Panel

Interpolation = Literal["linear", "nearest"]
INTERPOLATIONS: tuple[Interpolation, ...] = ("linear", "nearest")
_ROWS = 16  # of the panel that are woven at a time
_GROUP_BYTES = 1 << 30  # of views that are held at a time
_TYPES = (torch.uint8, torch.uint16, torch.float32)


class ViewSource(Protocol):
    """Views that are read when they are wanted, the left-most camera's first, all of one size and type."""

    count: int
    height_px: int
    width_px: int

    def view(self, number: int) -> np.ndarray | Tensor:
        """[H, W, 3] uint8, uint16 or float32."""
        ...


class _Stack:
    """Views that are all there, [M, H, W, 3]."""

    def __init__(self, views: np.ndarray | Tensor):
        self.views = dense_tensor("views", views)
        if self.views.dim() != 4 or self.views.shape[3] != 3 or 0 in self.views.shape:
            raise InputError(f"views: expected [M, H, W, 3], got {list(self.views.shape)}")
        self.count, self.height_px, self.width_px = self.views.shape[:3]

    def view(self, number: int) -> Tensor:
        return self.views[number]


@torch.no_grad()
def weave(
    views: np.ndarray | Tensor | ViewSource,
    panel: Panel,
    *,
    interpolation: Interpolation = "linear",
    place: Views = "integer",
    view_map: np.ndarray | None = None,
    aspect: float | None = None,
    fit: Fit = "cover",
    crop: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    shift: float = 0.0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    device: str = "cpu",
) -> Tensor:
    """The image [H, W, 3] of a panel from M views of any size, in their type: uint8, uint16 or float32 (0..1).

    views: [M, h, w, 3], the left-most camera's first, as quilts have them, or a ViewSource, of which at most 1 GiB is
    held at a time.
    interpolation: between the two views beside a sub-pixel that falls between them: "linear" mixes them, "nearest"
    takes one. place: "integer": of the panel's integer view; "continuous": of its exact x. Where M is the panel's N,
    integer places need no interpolation: every sub-pixel is that of one view, as `interlace` has it.
    view_map: int32 [H, W, 3] in place of the panel's lens: which of the M views, 0 being the right-most camera's, or
    -1 for the background.
    aspect: width by height of a view as it is seen (None: of square pixels). fit: "cover" fills the panel and cuts off
    what does not fit, "contain" shows all before the background, "stretch" distorts. crop: shares 0..1 of a view that
    are cut off at its left, top, right and bottom first.
    shift: how far the right-most camera's view moves to the right against the left-most one's, in widths of a view,
    those between in proportion, -1..1: above 0 the scene moves back behind the panel, below 0 out of it. What shows
    beside a view then is background, or with "cover" is cut off.
    A sub-pixel has the place of its pixel in the picture, as in `encode`: colours there are bilinear, of a view that
    is larger than it will be seen averaged first, and where sizes agree copies. Raises InputError.
    """
    source = _source(views)
    _check(panel, interpolation, place, background, device)
    seen_aspect = source.width_px / source.height_px if aspect is None else real_number("aspect", aspect, 0.01, 100)
    window = window_of(panel, (source.width_px, source.height_px), seen_aspect, fit, crop, shift)
    table = None if view_map is None else checked_view_map(view_map, panel, source.count)
    first = _picture(source, 0, window, device)
    out = torch.empty(panel.height_px, panel.width_px, 3, dtype=first.dtype, device=device)
    plain = torch.tensor(background, dtype=torch.float64, device=device)
    out[:] = _stored(plain * _full_scale(first.dtype), first.dtype)
    nearest = interpolation == "nearest"
    taps = taps_across(window, source.count, device), taps_down(window, device)
    for start, stack in _groups(source, window, first, device):
        end = source.count if start + len(stack) == source.count else start + len(stack) - 1
        for rows, places in _places(panel, source.count, place == "continuous", table):
            at = torch.from_numpy(places).to(device)
            low = (at + 0.5 if nearest else at).floor().clamp_(0, source.count - 1).to(torch.int64)
            mine = (at >= 0) & (low >= start) & (low < end)
            share = None if nearest else (at - low).clamp_(0, 1).float()
            share = share if share is not None and bool((share > 0).any()) else None
            if share is None and window.copies:
                _copy_rows(out, rows, low, mine, stack, start)
            else:
                _mix_rows(out, rows, low, share, mine, stack, start, source.count, taps)
    return out


def _copy_rows(out: Tensor, rows: slice, low: Tensor, mine: Tensor, stack: Tensor, start: int) -> None:
    """Draws those sub-pixels of some rows that are `mine`: those of their view at the same place."""
    # torch gathers no uint16: by their bits
    bits = torch.int16 if stack.dtype == torch.uint16 else stack.dtype
    slot = (low - start).clamp_(0, len(stack) - 1)
    values = stack.view(bits)[:, rows].gather(0, slot[None])[0]
    drawn = out[rows].view(bits)
    drawn.copy_(torch.where(mine, values, drawn))


def _mix_rows(
    out: Tensor,
    rows: slice,
    low: Tensor,
    share: Tensor | None,
    mine: Tensor,
    stack: Tensor,
    start: int,
    count: int,
    taps: tuple[Taps, Taps],
) -> None:
    """Draws those sub-pixels of some rows that are `mine`: of view `low`, and `share` of the next one."""
    most = len(stack) - 1
    values, inside = sampled(stack, (low - start).clamp(0, most), low, rows, *taps)
    if share is not None:
        upper = (low + 1).clamp_max(count - 1)
        other, beside = sampled(stack, (upper - start).clamp(0, most), upper, rows, *taps)
        # Where only one of the two reaches, it alone is shown
        share = torch.where(inside & beside, share, beside.to(share))
        values, inside = values.lerp_(other, share), inside | beside
    drawn = out[rows]
    bits = torch.int16 if out.dtype == torch.uint16 else out.dtype
    drawn.view(bits).copy_(torch.where(mine & inside, _stored(values, out.dtype).view(bits), drawn.view(bits)))


def _stored(values: Tensor, dtype: torch.dtype) -> Tensor:
    """float64 values as they are stored; integers are rounded, ties to even."""
    if dtype == torch.float32:
        return values.to(dtype)
    return values.round().clamp(0, _full_scale(dtype)).to(torch.int32).to(dtype)


def _full_scale(dtype: torch.dtype) -> float:
    return {torch.uint8: 255.0, torch.uint16: 65535.0}.get(dtype, 1.0)


def _groups(source: ViewSource, window: Window, first: Tensor, device: str) -> Iterator[tuple[int, Tensor]]:
    """Views in groups that fit into memory, [G, h, w, 3], and the number of the first of each; each group but the
    first begins with the last view of the one before."""
    if isinstance(source, _Stack) and source.views.device == first.device and source.views.shape[1:] == first.shape:
        yield 0, source.views.contiguous()  # they are all held anyway
        return
    each = max(2, _GROUP_BYTES // max(1, first.numel() * first.element_size()))
    start = 0
    while True:
        end = min(source.count, start + each)
        stack = torch.empty(end - start, *first.shape, dtype=first.dtype, device=device)
        for number in range(start, end):
            picture = first if number == 0 else _picture(source, number, window, device)
            if picture.shape != first.shape or picture.dtype != first.dtype:
                raise InputError(
                    f"views: expected all of one size and type, view {number} is {list(picture.shape)} "
                    f"{picture.dtype}, view 0 {list(first.shape)} {first.dtype}"
                )
            stack[number - start] = picture
        yield start, stack
        if end == source.count:
            return
        start = end - 1
        del stack


def _picture(source: ViewSource, number: int, window: Window, device: str) -> Tensor:
    """A view at the resolution that it is sampled at. Raises InputError."""
    picture = dense_tensor("views", source.view(number)).to(device)
    if picture.dtype not in _TYPES:
        raise InputError(f"views: expected uint8, uint16 or float32, got {picture.dtype}")
    return reduced_picture(picture, window)


def _places(panel: Panel, count: int, continuous: bool, table: np.ndarray | None) -> Iterator[tuple[slice, np.ndarray]]:
    """Chunks of rows and where their sub-pixels stand among the views, float64 [R, W, 3]: 0 is the left-most camera's;
    -1 where nothing is shown. At either end of the fan the outermost view goes on."""
    for rows, phase in panel.phase_rows(_ROWS):
        if table is not None:
            numbers = table[rows].astype(np.float64)
            yield rows, np.where(numbers < 0, -1.0, count - 1 - numbers)
            continue
        views = panel.views
        if continuous:
            x = panel.view_position(phase)
            at = x if panel.invert_views else views - x
        else:
            # By whole numbers first, so that views of as many fall exactly on one
            n = panel.view_index(phase).astype(np.float64)
            at = (n if panel.invert_views else views - 1 - n) + 0.5
        yield rows, np.clip((at * count - 0.5 * views) / views, 0.0, count - 1.0)


def _source(views: np.ndarray | Tensor | ViewSource) -> ViewSource:
    if isinstance(views, (np.ndarray, Tensor)):
        return _Stack(views)
    if not all(hasattr(views, name) for name in ("count", "height_px", "width_px", "view")):
        expect("views", views, np.ndarray, Tensor)
    return views


def _check(panel: Panel, interpolation: str, place: str, background: tuple[float, float, float], device: str) -> None:
    expect("panel", panel, Panel)
    for name, value, known in (
        ("interpolation", interpolation, INTERPOLATIONS),
        ("place", place, ("integer", "continuous")),
        ("device", device, ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)),
    ):
        if not isinstance(value, str) or value not in known:
            raise InputError(f"{name} must be {' or '.join(known)}, got {shown(value)}")
    if not is_row(background, 3):
        raise InputError(f"background: expected red, green and blue, got {shown(background)}")
    for part in background:
        real_number("background", part, 0, 1)
