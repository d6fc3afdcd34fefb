"""Positions of a panel's sub-pixels among the views, and of its pixels in the views' pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lightfield_gs import _core
from lightfield_gs.base.checks import is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel, panel_lens

_ROWS = 16  # of the panel at a time


@dataclass(frozen=True)
class Fan:
    """M views, 0 the left-most camera's, and their weights in the sub-pixels of a panel.

    Attributes:
        count: M.
        continuous: Position views by the lens's exact x, not by the panel's integer view.
        table: int32 [H, W, 3] in place of the lens, see `weave`.
        box: Width, in views of the M, of the box that each sub-pixel averages. Each view stands for the positions that
            are nearer to it than to another, the outermost for all beyond. Its weight is its part of the box. A box of
            1 is linear interpolation, a box of 0 the nearest view.
    """

    panel: Panel
    count: int
    continuous: bool
    table: np.ndarray | None
    box: float

    @property
    def most_mixed(self) -> int:
        """The most views that a sub-pixel mixes."""
        return min(self.count, math.ceil(self.box) + 1)

    def places(self) -> np.ndarray:
        """Return the place of each view of the panel, or of the table, among the M views, float64: 0 .. M - 1.

        At either end of the fan the outermost view goes on.
        """
        if self.table is not None:
            return np.arange(self.count - 1, -1, -1.0)
        n = np.arange(self.panel.views, dtype=np.float64)
        # By whole numbers first, so that equally many views fall exactly on one view
        return self._among((n if self.panel.invert_views else self.panel.views - 1 - n) + 0.5)

    def rows(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield chunks of rows and the places of their sub-pixels, float64 [R, W, 3]; -1 where nothing is shown."""
        panel, places = self.panel, self.places()
        for rows, phase in panel.phase_rows(_ROWS):
            if self.table is not None:
                numbers = self.table[rows]
                yield rows, np.where(numbers < 0, -1.0, places[numbers])
            elif self.continuous:
                x = panel.view_position(phase)
                yield rows, self._among(x if panel.invert_views else panel.views - x)
            else:
                yield rows, places[panel.view_index(phase)]

    def native(self, places: np.ndarray) -> _core.WeaveFan:
        """Return the fan for the native code; `places`, of places(), must live as long."""
        panel, table = self.panel, self.table
        view_map = (
            _core.ViewMap(panel_lens(panel).native())
            if table is None
            else _core.ViewMap(panel.width_px, panel.height_px, self.count, table.ctypes.data)
        )
        by_lens = self.continuous and table is None
        return _core.WeaveFan(view_map, places.ctypes.data, by_lens, panel.invert_views, self.count, self.box)

    def _among(self, at: np.ndarray) -> np.ndarray:
        """Convert places among the panel's views, whose edges are 0 and N, to places among the M."""
        views = self.panel.views
        return np.clip((at * self.count - 0.5 * views) / views, 0.0, self.count - 1.0)


Fit = Literal["cover", "contain", "stretch"]
FITS: tuple[Fit, ...] = ("cover", "contain", "stretch")
_SAME_ASPECT = 0.01  # aspects that differ by less are one: names round them, 1.77 for 16 / 9


@dataclass(frozen=True)
class Window:
    """The part of every view that the panel shows, in fractions of the view, which may reach beyond 0..1.

    Attributes:
        left, top, width, height: The whole panel.
        low_x, low_y, high_x, high_y: The part of the view that the crop leaves.
        shift: See `weave`.
        panel_px: Width and height.
        view_px: Width and height of the view as it is sampled.
    """

    left: float
    top: float
    width: float
    height: float
    low_x: float
    low_y: float
    high_x: float
    high_y: float
    shift: float
    panel_px: tuple[int, int]
    view_px: tuple[int, int]


def find_window(
    panel: Panel,
    view_px: tuple[int, int],
    aspect: float,
    fit: str,
    crop: tuple[float, float, float, float],
    shift: float,
) -> Window:
    """Return the part of each view that the panel shows. Raises InputError.

    Views that are larger than they will be seen are to be reduced to view_px of the window first.

    Args:
        panel: of the image.
        view_px: width and height of a view.
        aspect: width by height of a view as it is seen.
        fit: see `weave`, and so are crop and shift.
    """
    if fit not in FITS:
        raise InputError(f"fit must be {', '.join(FITS)}, got {shown(fit)}")
    shift = real_number("shift", shift, -1, 1)
    if not is_row(crop, 4):
        raise InputError(f"crop must be fractions of left, top, right and bottom, got {shown(crop)}")
    left, top, right, bottom = (real_number("crop", part, 0, 1) for part in crop)
    width, height = 1 - left - right, 1 - top - bottom
    if fit == "cover":  # the area that a shift uncovers beside the outermost views is cut off
        width -= abs(shift)
    if width < 0.01 or height < 0.01:
        raise InputError("crop and shift leave nothing of the views; give smaller ones")
    middle_x, middle_y = (left + 1 - right) / 2, (top + 1 - bottom) / 2
    shown_aspect = aspect * width / height
    wider = shown_aspect / (panel.width_px / panel.height_px)
    shown_width, shown_height = width, height
    if fit != "stretch" and abs(wider - 1) > _SAME_ASPECT:
        if (wider > 1) == (fit == "cover"):
            shown_width /= wider
        else:
            shown_height *= wider
    window = Window(
        middle_x - shown_width / 2,
        middle_y - shown_height / 2,
        shown_width,
        shown_height,
        left,
        top,
        1 - right,
        1 - bottom,
        shift,
        (panel.width_px, panel.height_px),
        view_px,
    )
    return _sampled_at(window)


def _sampled_at(window: Window) -> Window:
    """Return the window of views that are not larger than they will be seen."""
    sizes = [
        max(1, round(view * min(1.0, panel / (view * fraction))))
        for view, panel, fraction in zip(window.view_px, window.panel_px, (window.width, window.height))
    ]
    return Window(**{**vars(window), "view_px": (sizes[0], sizes[1])})
