"""The sub-pixels of a panel sorted by the view that they show (Shi et al., Photonics 2025, 12(3), 279, section 3.1)."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import to_tensor
from lightfield_gs.base.checks import expect, shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import MAX_VIEWS, Panel, panel_lens

BLOCK = _core.SUBPIXEL_BLOCK  # sub-pixels that are drawn together; every list is filled up to whole blocks
_SUBPIXELS_PER_TILE = 224  # of one view, on the average
_MOST_TILE_PIXELS = 1 << 14  # what 16 bits can address
_MOST_DISTINCT_VIEWS = 65536


class SortedPlan:
    """The sub-pixels of each view, made once per panel and used for any number of images.

    Sub-pixels are coded (view, tile, column, row, channel) and sorted. The list of a (view, tile) holds 16 bits for
    each of its sub-pixels. It is padded to a multiple of BLOCK (the paper's (-1, -1)).

    A view has 1/N of the sub-pixels, so tiles grow with N. A tile is as high as a square with one block of a view's
    sub-pixels, a power of two. On the CPU it always has 16 rows, a band. Its width is chosen for 224 sub-pixels, seven
    of the eight blocks that are drawn at a time. No tile is larger than 2^14 pixels.

    shown: indices of the views that some sub-pixel shows, int64 [V], ascending.
    hidden: whether some sub-pixel shows no view (-1 in the map).
    """

    def __init__(
        self,
        panel: Panel,
        view_map: np.ndarray | Tensor | None = None,
        views: int | None = None,
        device: torch.device | str = "cpu",
    ):
        """Sort the sub-pixels.

        Args:
            panel: its lens determines the view of each sub-pixel.
            view_map: in place of the lens: int32 [H, W, 3] by image channel, 0 .. views - 1, or -1 where a sub-pixel
                shows nothing.
            views: how many there are; None: the panel's.
            device: where the plan will be used.

        Raises:
            InputError: for arguments of other types, shapes or values.
        """
        expect("panel", panel, Panel)
        self.width_px, self.height_px = panel.width_px, panel.height_px
        self.views = panel.views if views is None else whole_number("views", views, 1, MAX_VIEWS)
        self.device_type = _device_type(device)
        self._table = None if view_map is None else checked_view_map(view_map, panel, self.views)
        self._map = (
            _core_map(panel)
            if self._table is None
            else _core.ViewMap(self.width_px, self.height_px, self.views, self._table.ctypes.data)
        )
        self.tile = _tile(self.views, self.width_px, self.device_type)
        self.tiles = self.tile.count(self.width_px, self.height_px)
        self._codes: Tensor | None = None  # of all lists, on the host
        self._resident: tuple[Tensor, Tensor] | None = None  # starts and codes on another device
        self._count()

    def _count(self) -> None:
        """Count the sub-pixels of every view and tile, and find where each list starts among the codes."""
        every = torch.arange(self.views, dtype=torch.int32)
        counts = torch.empty(self.views, self.tiles, dtype=torch.int32)
        _core.plan_sorted_count(
            self._map, self.tile, every.data_ptr(), self.views, counts.data_ptr(), torch.get_num_threads()
        )
        totals = counts.sum(1)
        self.hidden = int(totals.sum()) < 3 * self.width_px * self.height_px
        self.shown = totals.nonzero().squeeze(1).numpy()
        self.starts = torch.zeros(len(self.shown) * self.tiles + 1, dtype=torch.int64)  # of the lists in the codes
        for place, view in enumerate(self.shown.tolist()):  # without another array as large as `counts`
            padded = (counts[view] + (BLOCK - 1)).div_(BLOCK, rounding_mode="floor").mul_(BLOCK).to(torch.int64)
            lists = slice(place * self.tiles + 1, (place + 1) * self.tiles + 1)
            self.starts[lists] = padded.cumsum_(0).add_(self.starts[lists.start - 1])

    @property
    def count(self) -> int:
        """V, the number of views shown."""
        return len(self.shown)

    def bytes(self, first: int = 0, last: int | None = None) -> int:
        """Return the bytes of the starts and codes of the lists of shown views first .. last - 1."""
        last = self.count if last is None else last
        starts = self.starts.numpy()  # single numbers are read faster than from a tensor
        codes = int(starts[last * self.tiles] - starts[first * self.tiles])
        return 8 * ((last - first) * self.tiles + 1) + 2 * codes

    def table_bytes(self) -> int:
        """Return the bytes of the plan without codes."""
        return 8 * self.starts.numel() + 4 * self.views

    def lists(self, first: int, last: int, device: torch.device, keep: bool, threads: int) -> tuple[Tensor, Tensor]:
        """Return starts and codes of shown views first .. last - 1 on the device.

        Args:
            keep: Hold them on the device.
        """
        begin, end = first * self.tiles, last * self.tiles
        if device.type == "cpu" and not keep:
            starts = self.starts[begin : end + 1] - self.starts[begin]
            return starts, self._fill(first, last, starts, threads)
        if self._codes is None:
            self._codes = self._fill(0, self.count, self.starts, threads)
        if device.type == "cpu":
            return self.starts[begin : end + 1], self._codes
        if keep:
            if self._resident is None or self._resident[0].device != device:
                self._resident = (self.starts.to(device), self._codes.to(device))
            return self._resident[0][begin : end + 1], self._resident[1]
        codes = self._codes[int(self.starts[begin]) : int(self.starts[end])]
        return (self.starts[begin : end + 1] - self.starts[begin]).to(device), codes.to(device)

    def release(self) -> None:
        """Free what `lists` holds on the device of the images."""
        self._resident = None
        if self.device_type == "cpu":
            self._codes = None

    def _fill(self, first: int, last: int, starts: Tensor, threads: int) -> Tensor:
        """Return the codes of the lists of shown views first .. last - 1, int16, on the host."""
        places = torch.full((self.views,), -1, dtype=torch.int32)
        places[self.shown[first:last]] = torch.arange(last - first, dtype=torch.int32)
        codes = torch.empty(int(starts[-1]), dtype=torch.int16)
        _core.plan_sorted_fill(
            self._map, self.tile, places.data_ptr(), last - first, starts.data_ptr(), codes.data_ptr(), threads
        )
        return codes


@lru_cache(maxsize=1)
def panel_plan(panel: Panel, device_type: str) -> SortedPlan:
    """Return the plan of a panel's own lens; the last one is cached."""
    return SortedPlan(panel, device=device_type)


def checked_view_map(view_map: np.ndarray | Tensor, panel: Panel, views: int) -> np.ndarray:
    """Return the map as a C-contiguous array, after checking its shape, type and values. Raises InputError."""
    isarray = isinstance(view_map, np.ndarray)  # which may be a file, mapped and read-only
    table = view_map if isarray else to_tensor("view_map", view_map).detach().cpu().numpy()
    shape = (panel.height_px, panel.width_px, 3)
    if table.shape != shape or table.dtype != np.int32:
        raise InputError(f"view_map must be int32 {list(shape)} for this panel, got {table.dtype} {list(table.shape)}")
    low, high = int(table.min()), int(table.max())
    if low < -1 or high >= views:
        raise InputError(f"view_map must hold 0..{views - 1}, or -1 where nothing is shown, got {low}..{high}")
    return np.ascontiguousarray(table)


def _device_type(device: torch.device | str) -> str:
    try:
        return torch.device(device).type
    except (RuntimeError, TypeError, ValueError):
        raise InputError(f"device: expected cpu or cuda, got {shown(device)}") from None


def views_shown(panel: Panel, continuous: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return for every sub-pixel (flat) its index in x, and x: the distinct camera coordinates that the panel shows."""
    view_map = panel.view_map(continuous).reshape(-1)
    if not continuous:
        used = np.bincount(view_map, minlength=panel.views) > 0
        places = view_map if used.all() else (np.cumsum(used) - 1).astype(np.int32)[view_map]
        return places, np.flatnonzero(used) + 0.5
    # Coordinates that differ only by the rounding of the fixed-point phase are one; a few rows already tell a panel
    # that has too many
    view_map = np.round(view_map, 9)
    if len(np.unique(view_map[: 2**21])) <= _MOST_DISTINCT_VIEWS:
        x, places = np.unique(view_map, return_inverse=True)
        if len(x) <= _MOST_DISTINCT_VIEWS:
            return places, x
    raise InputError(
        "methods classic and sorted take a camera for every distinct view, and this panel shows more "
        f"than {_MOST_DISTINCT_VIEWS} continuous ones: use method direct, or integer views"
    )


def _core_map(panel: Panel) -> _core.ViewMap:
    return _core.ViewMap(panel_lens(panel).native())


def _tile(views: int, width_px: int, device_type: str) -> _core.SubpixelTile:
    """Return the size of a plan's tiles, by the rule in the docstring of SortedPlan."""
    rows = math.sqrt(BLOCK * views / 3)
    bits = int(math.log2(_core.BAND_ROWS)) if device_type == "cpu" else min(max(round(math.log2(rows)), 2), 7)
    width = round(_SUBPIXELS_PER_TILE * views / 3 / (1 << bits))
    return _core.SubpixelTile(min(max(width, 1), _MOST_TILE_PIXELS >> bits, width_px), bits)
