"""Where a panel's pixels lie in the pictures that it is woven from: fit, crop and shift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from lightfield_gs.base.checks import is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel

Fit = Literal["cover", "contain", "stretch"]
FITS: tuple[Fit, ...] = ("cover", "contain", "stretch")
_SAME_ASPECT = 0.01  # aspects that differ by less are one: names round them, 1.77 for 16 / 9


@dataclass(frozen=True)
class Window:
    """What of every view the panel shows, in shares of the view, which may reach beyond 0..1.

    left, top, width, height: of the whole panel. low_x, low_y, high_x, high_y: what is left of the view by the crop.
    shift: see `weave`. panel_px, view_px: width and height, of the view as it is sampled.
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


def window_of(
    panel: Panel,
    view_px: tuple[int, int],
    aspect: float,
    fit: str,
    crop: tuple[float, float, float, float],
    shift: float,
) -> Window:
    """What the panel shows of views of this size and aspect. Views that are larger than they will be seen are to be
    reduced to view_px of the window first. Raises InputError."""
    if fit not in FITS:
        raise InputError(f"fit must be {', '.join(FITS)}, got {shown(fit)}")
    shift = real_number("shift", shift, -1, 1)
    if not is_row(crop, 4):
        raise InputError(f"crop must be shares of left, top, right and bottom, got {shown(crop)}")
    left, top, right, bottom = (real_number("crop", part, 0, 1) for part in crop)
    width, height = 1 - left - right, 1 - top - bottom
    if fit == "cover":  # what a shift uncovers beside the outermost views is cut off
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
    """The window of views that are not larger than they will be seen."""
    sizes = [
        max(1, round(view * min(1.0, panel / (view * share))))
        for view, panel, share in zip(window.view_px, window.panel_px, (window.width, window.height))
    ]
    return Window(**{**vars(window), "view_px": (sizes[0], sizes[1])})
