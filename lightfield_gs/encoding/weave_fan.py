"""Where the sub-pixels of a panel stand among the views that it is woven from."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lightfield_gs import _core
from lightfield_gs.panels.lens import lens_of
from lightfield_gs.panels.panel import Panel

_ROWS = 16  # of the panel at a time


@dataclass(frozen=True)
class Fan:
    """M views, 0 the left-most camera's, and what of them the sub-pixels of a panel show.

    count: M. continuous: places by the lens's exact x, not by the panel's integer view. table: int32 [H, W, 3] in
    place of the lens, see `weave`. box: how many of the M views wide each sub-pixel averages: each view stands for the
    places that are nearer to it than to another, the outermost for all beyond, and its share is how much of the box is
    its. A box of 1 is linear interpolation, one of 0 the nearest view.
    """

    panel: Panel
    count: int
    continuous: bool
    table: np.ndarray | None
    box: float

    @property
    def most_mixed(self) -> int:
        """How many views a sub-pixel mixes at most."""
        return min(self.count, math.ceil(self.box) + 1)

    def places(self) -> np.ndarray:
        """Where each view of the panel, or of the table, stands among the M, float64: 0 .. M - 1. At either end of the
        fan the outermost view goes on."""
        if self.table is not None:
            return np.arange(self.count - 1, -1, -1.0)
        n = np.arange(self.panel.views, dtype=np.float64)
        # By whole numbers first, so that views of as many fall exactly on one
        return self._among((n if self.panel.invert_views else self.panel.views - 1 - n) + 0.5)

    def rows(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Chunks of rows and the places of their sub-pixels, float64 [R, W, 3]; -1 where nothing is shown."""
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
        """For the native code; `places`, what places() returned, must live as long."""
        panel, table = self.panel, self.table
        view_map = (
            _core.ViewMap(lens_of(panel).native())
            if table is None
            else _core.ViewMap(panel.width_px, panel.height_px, self.count, table.ctypes.data)
        )
        by_lens = self.continuous and table is None
        return _core.WeaveFan(view_map, places.ctypes.data, by_lens, panel.invert_views, self.count, self.box)

    def _among(self, at: np.ndarray) -> np.ndarray:
        """Places among the panel's views, whose edges are 0 and N, as places among the M."""
        views = self.panel.views
        return np.clip((at * self.count - 0.5 * views) / views, 0.0, self.count - 1.0)
