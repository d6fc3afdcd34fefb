"""Interlace views of any size and number, from a quilt, a folder or a light field, to the image of a panel.

View q of M, counted from the left-most camera, stands at the place (q + 1/2) / M of the fan. A sub-pixel that shows
the panel's x of N views stands at 1 - x / N (with invert_views x / N). So a panel's integer views fall exactly on the
views of a set of the same size.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import to_tensor
from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Views
from lightfield_gs.encoding.sorted_plan import checked_view_map
from lightfield_gs.encoding.weave_geometry import Fan, Fit, Window, find_window
from lightfield_gs.encoding.weave_sampling import Held, NativePasses, TorchPasses, full_scale, reduced_picture, stored
from lightfield_gs.panels.panel import MAX_VIEWS, Panel

Interpolation = Literal["linear", "nearest"]
INTERPOLATIONS: tuple[Interpolation, ...] = ("linear", "nearest")
_GROUP_BYTES = 1 << 30  # of views that are held at a time
_TYPES = (torch.uint8, torch.uint16, torch.float32)


class ViewSource(Protocol):
    """Views that are read one by one, the left-most camera's first, all of one size and type."""

    count: int
    height_px: int
    width_px: int

    def view(self, number: int) -> np.ndarray | Tensor:
        """[H, W, 3] uint8, uint16 or float32."""
        ...


class _Stack:
    """Views in memory, [M, H, W, 3]."""

    def __init__(self, views: np.ndarray | Tensor):
        self.views = to_tensor("views", views)
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
    view_filter: float = 0.0,
    view_map: np.ndarray | None = None,
    aspect: float | None = None,
    fit: Fit = "cover",
    crop: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    shift: float = 0.0,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    device: str = "cpu",
) -> Tensor:
    """Interlace M views of any size to the image [H, W, 3] of a panel, in their type: uint8, uint16 or float32 (0..1).

    A sub-pixel shows the point of the picture where its pixel lies, as in `encode`. Colours there are bilinear. A view
    that is larger than its picture on the panel is averaged first; where sizes agree, colours are copied.

    Args:
        views: [M, h, w, 3], the left-most camera's first, as in quilts; or a ViewSource. Of a ViewSource at most 1 GiB
            is held at a time, or twice as many views as a sub-pixel mixes if that is more.
        panel: its lens determines the view of each sub-pixel.
        interpolation: "linear" mixes the two views beside a sub-pixel, "nearest" takes one of them.
        place: "integer": a sub-pixel looks from its integer view; "continuous": from its exact x. If M is the panel's
            N, integer places need no interpolation: every sub-pixel comes from one view, as in `interlace`.
        view_filter: width of angular anti-aliasing in views of the panel, 0 (none) to 65536. Each sub-pixel is the mean
            over a box of this width around its place. Points far from the panel then do not flicker as the eye moves,
            and become softer. (Halle, "Holographic stereograms as discrete imaging systems", 1994; Zwicker et al.,
            "Antialiasing for automultiscopic 3D displays", 2006.) Each view stands for the places nearest to it. If M
            is N, 1 does nothing and 2 mixes 1/4, 1/2, 1/4 of three views. If M is 2 N, 1 is the mean of two views.
        view_map: int32 [H, W, 3], in place of the panel's lens: the index of a view, 0 for the right-most camera, or -1
            for the background.
        aspect: width by height of a view as it is seen; None: of square pixels.
        fit: "cover" fills the panel and cuts off the rest, "contain" shows all before the background, "stretch"
            distorts.
        crop: fractions 0..1 of a view that are cut off first, at its left, top, right and bottom.
        shift: movement of the right-most camera's view to the right against the left-most one's, -1..1 widths of a
            view. Views between move in proportion. Above 0 the scene moves back behind the panel, below 0 out of the
            panel. The gap beside a view shows the background, or with "cover" is cut off.
        background: red, green and blue in 0..1.
        device: cpu or cuda, where the image is made.

    Returns:
        The image, on the device.

    Raises:
        InputError: views differ in size or type, or an argument is out of its range.
    """
    source = _source(views)
    _check(panel, interpolation, place, background, device)
    width = real_number("view_filter (views)", view_filter, 0.0, MAX_VIEWS)
    seen_aspect = source.width_px / source.height_px if aspect is None else real_number("aspect", aspect, 0.01, 100)
    window = find_window(panel, (source.width_px, source.height_px), seen_aspect, fit, crop, shift)
    table = None if view_map is None else checked_view_map(view_map, panel, source.count)
    fan = Fan(panel, source.count, place == "continuous", table, _box(panel, source.count, table, interpolation, width))
    first = _picture(source, 0, window, device)
    out = torch.empty(panel.height_px, panel.width_px, 3, dtype=first.dtype, device=device)
    plain = torch.tensor(background, dtype=torch.float64, device=device)
    out[:] = stored(plain * full_scale(first.dtype), first.dtype)
    passes = NativePasses(fan, window) if device == "cpu" else TorchPasses(fan, window, device)
    for held in _groups(source, window, first, device, fan.most_mixed):
        passes.draw(out, held)
    return out


def _box(panel: Panel, count: int, table: np.ndarray | None, interpolation: str, width: float) -> float:
    """Return the width of the box that each sub-pixel averages, see Fan, for `weave`'s options."""
    wide = width if table is not None else width * count / panel.views
    return min(float(count), max(wide, 1.0 if interpolation == "linear" else 0.0))


def _groups(source: ViewSource, window: Window, first: Tensor, device: str, most_mixed: int) -> Iterator[Held]:
    """Yield views in groups that fit into memory.

    Groups overlap by the number of views that a sub-pixel mixes, less one.
    """
    if isinstance(source, _Stack) and source.views.device == first.device and source.views.shape[1:] == first.shape:
        yield Held(source.views.contiguous(), 0, source.count)  # they are all held anyway
        return
    each = max(2 * most_mixed, _GROUP_BYTES // max(1, first.numel() * first.element_size()))
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
        own = len(stack) if end == source.count else len(stack) - (most_mixed - 1)
        yield Held(stack, start, own)
        if end == source.count:
            return
        start += own
        del stack


def _picture(source: ViewSource, number: int, window: Window, device: str) -> Tensor:
    """Return a view at the resolution that it is sampled at. Raises InputError."""
    picture = to_tensor("views", source.view(number)).to(device)
    if picture.dtype not in _TYPES:
        raise InputError(f"views: expected uint8, uint16 or float32, got {picture.dtype}")
    return reduced_picture(picture, window)


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
