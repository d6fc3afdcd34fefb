"""Patterns in labelled bands, each of which shows the panel under another value of one parameter, or another depth.

The band that looks right says the value: its label is what `lightfield-gs calibrate nudge` takes.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from lightfield_gs.base.checks import real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.lens_change import LensChange, changed
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.patterns import HEIGHT_DOTS, text_pixels, width_dots
from lightfield_gs.panels.patterns import draw, hues

Fan = Literal["pitch", "slope", "centre"]
_SPANS: dict[Fan, float] = {"pitch": 0.5, "slope": 2.5, "centre": 0.5}
_MOST_BANDS = 11
_LENSES_PER_DOT = 1.5  # for which there is room in every band
_LARGEST_DOT_LENSES = 4
_LABEL_CHARACTERS = 6
_MIDDLE_SHARE = 1 / 8  # of the views on either side of the middle one that are white in the fan of the centre
_STRIPE_LENSES = 8  # period of the stripes of the depth ramp
_MOST_PX = 1e5
_RAMP_LENSES = 6.0  # how far they move over the cone, at the ends


def fan(panel: Panel, parameter: Fan, span: float | None = None, bands: int | None = None) -> np.ndarray:
    """uint8 [H, W, 3] in bands, each drawn for the panel with `parameter` changed by the number it is labelled with.

    pitch: rows of the hues of `sweep`, changed by -span..span percent (default 0.5): of an eye at the viewing distance
    the right one has one colour from left to right. slope: the same in columns (default 2.5 percent), even from top to
    bottom. centre: rows that are white in the middle quarter of the views, changed by lens widths (default 0.5, that
    is all of them): straight in front the right one is the brightest. The panel's middle stays where it is, as in
    LensChange. bands: an odd number, 3..99; None: as many as leave room for labels, at most 11. Raises InputError.
    """
    if parameter not in _SPANS:
        raise InputError(f"fan: expected one of {', '.join(_SPANS)}, got {parameter!r}")
    span = real_number("span", _SPANS[parameter] if span is None else span, 1e-6, 50)
    upright = parameter == "slope"
    count = _band_count(panel, bands, upright)
    borders = np.linspace(0, panel.width_px if upright else panel.height_px, count + 1).round().astype(int)
    out = np.empty((panel.height_px, panel.width_px, 3), np.uint8)
    for value, first, last in zip(np.linspace(-span, span, count), borders, borders[1:]):
        band = changed(panel, _change(parameter, float(value)))
        rows, columns = slice(0, panel.height_px), slice(int(first), int(last))
        if not upright:
            rows, columns = columns, slice(0, panel.width_px)
        out[rows, columns] = draw(band, lambda x, _: _content(parameter, x / panel.views), rows, columns)
        _label(out[rows, columns], _written(float(value), span), panel)
    return out


def _change(parameter: Fan, value: float) -> LensChange:
    if parameter == "centre":
        return LensChange(centre=value)
    return LensChange(pitch_percent=value) if parameter == "pitch" else LensChange(slope_percent=value)


def _content(parameter: Fan, share: np.ndarray) -> np.ndarray:
    return np.abs(share - 0.5) < _MIDDLE_SHARE if parameter == "centre" else hues(share)


def depth_ramp(panel: Panel, most_px: float | None = None, bands: int | None = None) -> np.ndarray:
    """uint8 [H, W, 3]: upright stripes in rows of different depth, each labelled with its disparity.

    That is how far the stripes of the right-most view lie to the left of those of the left-most, in pixels: positive
    in front of the panel, 0 in it, negative behind it. The rows whose stripes are sharp say how much depth the panel
    shows. most_px: at the top row, its negative at the bottom; None: 6 lens widths. bands: see fan. Raises InputError.
    """
    lens_px = panel.line_number / 3
    most = real_number("most_px", min(_RAMP_LENSES * lens_px, _MOST_PX) if most_px is None else most_px, 0, _MOST_PX)
    count = _band_count(panel, bands, False)
    borders = np.linspace(0, panel.height_px, count + 1).round().astype(int)
    period, to_right = _STRIPE_LENSES * lens_px, -1 if panel.invert_views else 1
    out = np.empty((panel.height_px, panel.width_px, 3), np.uint8)
    columns = np.arange(panel.width_px)[:, None] + 0.5
    for disparity, first, last in zip(np.linspace(most, -most, count), borders, borders[1:]):

        def shade(x: np.ndarray, _: slice, disparity: float = float(disparity)) -> np.ndarray:
            place = columns + disparity * to_right * (0.5 - x / panel.views)
            return np.mod(place / period, 1) < 0.5

        out[first:last] = draw(panel, shade, slice(int(first), int(last)))
        _label(out[first:last], _written(float(disparity), most), panel)
    return out


def _written(value: float, largest: float) -> str:
    """The number with its sign, to three digits of the largest one, without an exponent."""
    decimals = max(0, 2 - math.floor(math.log10(largest))) if largest > 0 else 0
    text = f"{value:+.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _dot_px(panel: Panel) -> int:
    return math.ceil(_LENSES_PER_DOT * panel.line_number / 3)


def _band_count(panel: Panel, bands: int | None, upright: bool) -> int:
    if bands is not None:
        count = whole_number("bands", bands, 3, 99)
        if count % 2 == 0:
            raise InputError(f"bands: expected an odd number, so that one is unchanged, got {count}")
        return count
    room = panel.width_px // width_dots(_LABEL_CHARACTERS) if upright else panel.height_px // HEIGHT_DOTS
    fitting = min(_MOST_BANDS, room // _dot_px(panel))
    return max(3, fitting - (fitting + 1) % 2)


def _label(band: np.ndarray, text: str, panel: Panel) -> None:
    """Writes into the band's upper left corner, the same for all views, as large as fits up to 4 lenses a dot."""
    room = min(band.shape[0] // HEIGHT_DOTS, band.shape[1] // width_dots(len(text)))
    mask = text_pixels(text, max(1, min(room, math.ceil(_LARGEST_DOT_LENSES * panel.line_number / 3))))[
        : band.shape[0], : band.shape[1]
    ]
    band[: mask.shape[0], : mask.shape[1]] = 255 * mask[..., None]
