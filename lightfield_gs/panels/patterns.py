"""Test patterns that show how well a profile fits its panel: an eye before the panel sees which view reaches it.

All are uint8 [H, W, 3], for the sub-pixels of a view by `panel`. `fan` draws labelled bands, each with another value of
one parameter; `depth_ramp` draws them at different depths. The label of the best band is the value for `lightfield-gs
calibrate nudge`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.cells import PERIOD, subpixel_phases
from lightfield_gs.panels.lens_change import LensChange, changed
from lightfield_gs.panels.panel import Panel

# Three dots wide and five high, row by row
_GLYPHS = {
    "0": "### #.# #.# #.# ###",
    "1": ".#. ##. .#. .#. ###",
    "2": "### ..# ### #.. ###",
    "3": "### ..# .## ..# ###",
    "4": "#.# #.# ### ..# ..#",
    "5": "### #.. ### ..# ###",
    "6": "### #.. ### #.# ###",
    "7": "### ..# ..# .#. .#.",
    "8": "### #.# ### #.# ###",
    "9": "### #.# ### ..# ###",
    "+": "... .#. ### .#. ...",
    "-": "... ... ### ... ...",
    ".": "... ... ... ... .#.",
    " ": "... ... ... ... ...",
}
_DOTS = {letter: np.array([[dot == "#" for dot in row] for row in rows.split()]) for letter, rows in _GLYPHS.items()}
HEIGHT_DOTS = 7  # of a line of text, with a dot of margin on either side


def width_dots(characters: int) -> int:
    """Return the width of a number of characters, with a dot between them and a margin of one dot on either side."""
    return 4 * characters + 1


def text_dots(text: str) -> np.ndarray:
    """Return the lit dots of a text of digits, + - . and spaces: bool [HEIGHT_DOTS, width_dots(len(text))]."""
    out = np.zeros((HEIGHT_DOTS, width_dots(len(text))), bool)
    for position, letter in enumerate(text):
        out[1:6, 4 * position + 1 : 4 * position + 4] = _DOTS[letter]
    return out


def text_pixels(text: str, dot_px: int) -> np.ndarray:
    """Return the text with dots of dot_px x dot_px pixels: bool [HEIGHT_DOTS dot_px, width_dots(len(text)) dot_px]."""
    return text_dots(text).repeat(dot_px, 0).repeat(dot_px, 1)


_ROWS_PER_CHUNK = 64


@dataclass(frozen=True)
class PatternConstants:
    """Sizes and colours of the patterns, chosen by hand and not tuned."""

    # sub-pixels of one number: a lens lights about one, so that it covers five sixths of an eye's picture
    subpixels_per_number: float = 1.2
    numbers_across: int = 5  # numbers in a row of tiles, about
    lenses_per_dot: int = 2  # width of a dot of a digit, at least, so that it cannot fall between the samples
    # fraction of the colour circle, red to magenta, so that the two ends of the cone look different
    hue_span: float = 5 / 6
    bar_mean: float = 0.5  # mean light of the bars
    bar_amplitude: float = 0.45  # amplitude of the bars: neither black, nor so bright that a camera clips

    # Bands
    most_bands: int = 11  # bands by default, at most
    lenses_per_label_dot: float = 1.5  # width of a dot of a label that every band has space for
    largest_dot_lenses: int = 4  # width of a dot of a label, at most
    label_characters: int = 6  # characters of the longest label
    # fraction of the views on either side of the middle one that are white in the fan of the centre
    middle_fraction: float = 1 / 8
    stripe_lenses: int = 8  # period of the stripes of the depth ramp
    ramp_lenses: float = 6.0  # movement of the stripes over the cone, at the ends


_CONSTANTS = PatternConstants()


Shade = Callable[[np.ndarray, slice], np.ndarray]


def lens_phases(panel: Panel, rows: slice, columns: slice) -> np.ndarray:
    """Return lens phases uint64 [rows, columns, 3], by image channel, as Panel.phase_rows does for whole rows."""
    s0, sx, sy = (np.uint64(step) for step in panel.phase_steps())
    i, j = np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop)
    start = s0 + sy * i.astype(np.uint64)[:, None] + sx * (3 * j).astype(np.uint64)
    return start[..., None] + subpixel_phases(panel)[(i % PERIOD)[:, None], j % PERIOD]


def draw(panel: Panel, shade: Shade, rows: slice | None = None, columns: slice | None = None) -> np.ndarray:
    """Draw a shade of the views on the panel, uint8 [rows, columns, 3].

    Args:
        panel: The panel.
        shade: Function of views x in [0, N), float64 [part, columns, 3], and of their rows `part` of the panel. It
            returns 0..1, or bool.
        rows: Rows to draw; None: all.
        columns: Columns to draw; None: all.
    """
    rows, columns = rows or slice(0, panel.height_px), columns or slice(0, panel.width_px)
    out = np.empty((rows.stop - rows.start, columns.stop - columns.start, 3), np.uint8)
    for first in range(rows.start, rows.stop, _ROWS_PER_CHUNK):
        part = slice(first, min(first + _ROWS_PER_CHUNK, rows.stop))
        values = shade(panel.view_position(lens_phases(panel, part, columns)), part)
        out[part.start - rows.start : part.stop - rows.start] = np.rint(255.0 * values)
    return out


def hues(fraction: np.ndarray) -> np.ndarray:
    """Return the light of each channel in its hue, 0..1 [..., 3]; fraction: [..., 3], 0 for red to 1 for magenta."""
    # A channel is 1 within a sixth of the circle of its primary, and falls linearly over the next sixth
    turns = fraction * _CONSTANTS.hue_span - np.arange(3) / 3
    return np.clip(2 - 6 * np.abs(turns - np.round(turns)), 0, 1)


def sweep(panel: Panel, hue: bool = True) -> np.ndarray:
    """Draw every view in one colour: a hue, red (view 0) to magenta (view N - 1), or a grey, black to white.

    An eye at the viewing distance sees the panel in one colour; another profile makes bands of it.
    """
    last = max(1, panel.views - 1)
    return draw(panel, lambda x, _: hues(np.floor(x) / last) if hue else np.floor(x) / last)


def displayed_numbers(panel: Panel, step: int | None = None) -> np.ndarray:
    """Return the number that each view shows in `numbers`, int [N].

    A lens lights about one sub-pixel, which on many panels spans several views: 10 of 96 where line_number is 9.8.
    Their numbers would overlay each other, so that neighbours show the number of their middle view.

    Args:
        panel: The panel.
        step: Views that share a number, 1..N; None: as many as an eye cannot tell apart (1.2 sub-pixels).

    Raises:
        InputError: An argument is invalid.
    """
    expect("panel", panel, Panel)
    if step is None:
        step = min(panel.views, math.ceil(_CONSTANTS.subpixels_per_number * panel.views / panel.line_number))
    groups = panel.views // whole_number("step", step, 1, panel.views)
    group = np.arange(panel.views) * groups // panel.views
    first, after = (np.searchsorted(group, np.arange(groups), side) for side in ("left", "right"))
    return ((first + after - 1) // 2)[group]


def numbers(panel: Panel, step: int | None = None) -> np.ndarray:
    """Draw the number of each view, white on black, large and repeated over the panel.

    Views are numbered as in Panel: 0 for the right-most eye, unless invert_views.

    Args:
        step: See displayed_numbers.
    """
    shown_by_view = displayed_numbers(panel, step)
    different, which = np.unique(shown_by_view, return_inverse=True)
    tiles, (down, across) = _number_tiles(panel, different)

    def shade(x: np.ndarray, part: slice) -> np.ndarray:
        i, inside_down = down
        j, inside_across = across
        inside = inside_down[part, None, None] & inside_across[:, None]
        return tiles[which[x.astype(np.int64)], i[part, None, None], j[:, None]] & inside  # 0 or 1

    return draw(panel, shade)


def number_picture(panel: Panel, number: int, step: int | None = None) -> np.ndarray:
    """Return the white pixels, bool [H, W], of the picture with this number in `numbers`."""
    different = np.unique(displayed_numbers(panel, step))
    tiles, (down, across) = _number_tiles(panel, different)
    tile = tiles[np.searchsorted(different, number)]
    return tile[np.ix_(down[0], across[0])] & down[1][:, None] & across[1]


_Tiling = tuple[np.ndarray, np.ndarray]  # for each row (column): the dot of the tile, and whether a whole tile is there


def _number_tiles(panel: Panel, different: np.ndarray) -> tuple[np.ndarray, tuple[_Tiling, _Tiling]]:
    """Return a tile for each number, bool [count, h, w] in dots, and the tiling of rows and columns."""
    digits = len(str(different.max()))
    size, dots = (panel.height_px, panel.width_px), (HEIGHT_DOTS, width_dots(digits))
    largest = max(1, min(full // part for full, part in zip(size, dots)))
    least = math.ceil(_CONSTANTS.lenses_per_dot * panel.line_number / 3)
    dot_px = min(largest, max(least, size[1] // (_CONSTANTS.numbers_across * dots[1])))
    tiles = np.stack([text_dots(str(number).rjust(digits)) for number in different])
    down, across = (_tiling(full, part, dot_px) for full, part in zip(size, dots))
    return tiles, (down, across)


def _tiling(size_px: int, tile_dots: int, dot_px: int) -> _Tiling:
    """Return whole tiles in the middle of this number of pixels, or one cut tile."""
    tile_px = tile_dots * dot_px
    covered = max(1, size_px // tile_px) * tile_px
    position = np.arange(size_px) + (covered - size_px) // 2
    return position % tile_px // dot_px, (position >= 0) & (position < covered)


def single(panel: Panel, first: int, last: int | None = None) -> np.ndarray:
    """Draw view `first` white (views first..last, both included), all others black.

    Raises:
        InputError: There is no such view.
    """
    first = whole_number("view", first, 0, panel.views - 1)
    last = first if last is None else whole_number("last view", last, first, panel.views - 1)
    return draw(panel, lambda x, _: (x >= first) & (x < last + 1))


def bars(panel: Panel, shift: int | None = None) -> np.ndarray:
    """Draw light that is a cosine of the view, for calibration_fit: 0.5 + 0.45 cos(2 pi (x/N - shift/3)), as sRGB.

    Args:
        panel: The panel.
        shift: 0, 1 or 2, in grey; None: red has shift 0, green 1 and blue 2, all in one image.

    Raises:
        InputError: An argument is invalid.
    """
    shifts = np.arange(3) if shift is None else whole_number("shift", shift, 0, 2)
    turn = 2 * math.pi

    def shade(x: np.ndarray, _: slice) -> np.ndarray:
        return encode_srgb(
            _CONSTANTS.bar_mean + _CONSTANTS.bar_amplitude * np.cos(turn * (x / panel.views - shifts / 3))
        )

    return draw(panel, shade)


Fan = Literal["pitch", "slope", "centre"]
_SPANS: dict[Fan, float] = {"pitch": 0.5, "slope": 2.5, "centre": 0.5}
_MOST_PX = 1e5


def fan(panel: Panel, parameter: Fan, span: float | None = None, bands: int | None = None) -> np.ndarray:
    """Draw bands, each for the panel with one parameter changed by the number on its label: uint8 [H, W, 3].

    The panel's middle stays in phase, as in LensChange.

    Args:
        panel: The panel.
        parameter: "pitch": rows of the hues of `sweep`, changed by -span..span percent. For an eye at the viewing
            distance the right row has one colour from left to right. "slope": the same in columns; the right column is
            even from top to bottom. "centre": rows that are white in the middle quarter of the views, moved by lens
            widths. Seen from straight in front, the right row is the brightest.
        span: Largest change; None: 0.5 percent for pitch, 2.5 for slope, 0.5 lens widths (all of them) for centre.
        bands: An odd number, 3..99; None: as many as leave space for labels, at most 11.

    Raises:
        InputError: An argument is invalid.
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
        out[rows, columns] = draw(band, lambda x, _: _band_shade(parameter, x / panel.views), rows, columns)
        _label(out[rows, columns], _format_signed(float(value), span), panel)
    return out


def _change(parameter: Fan, value: float) -> LensChange:
    if parameter == "centre":
        return LensChange(centre=value)
    return LensChange(pitch_percent=value) if parameter == "pitch" else LensChange(slope_percent=value)


def _band_shade(parameter: Fan, fraction: np.ndarray) -> np.ndarray:
    return np.abs(fraction - 0.5) < _CONSTANTS.middle_fraction if parameter == "centre" else hues(fraction)


def depth_ramp(panel: Panel, most_px: float | None = None, bands: int | None = None) -> np.ndarray:
    """Draw upright stripes in rows of different depth, each labelled with its disparity: uint8 [H, W, 3].

    The disparity is how far, in pixels, the stripes of the right-most view lie to the left of the stripes of the
    left-most view. It is positive in front of the panel, 0 in its plane, negative behind it. The rows with sharp
    stripes show the depth that the panel can show.

    Args:
        panel: The panel.
        most_px: Disparity of the top row, its negative at the bottom; None: 6 lens widths.
        bands: See fan.

    Raises:
        InputError: An argument is invalid.
    """
    lens_px = panel.line_number / 3
    most = real_number(
        "most_px", min(_CONSTANTS.ramp_lenses * lens_px, _MOST_PX) if most_px is None else most_px, 0, _MOST_PX
    )
    count = _band_count(panel, bands, False)
    borders = np.linspace(0, panel.height_px, count + 1).round().astype(int)
    period, to_right = _CONSTANTS.stripe_lenses * lens_px, -1 if panel.invert_views else 1
    out = np.empty((panel.height_px, panel.width_px, 3), np.uint8)
    columns = np.arange(panel.width_px)[:, None] + 0.5
    for disparity, first, last in zip(np.linspace(most, -most, count), borders, borders[1:]):

        def shade(x: np.ndarray, _: slice, disparity: float = float(disparity)) -> np.ndarray:
            position = columns + disparity * to_right * (0.5 - x / panel.views)
            return np.mod(position / period, 1) < 0.5

        out[first:last] = draw(panel, shade, slice(int(first), int(last)))
        _label(out[first:last], _format_signed(float(disparity), most), panel)
    return out


def _format_signed(value: float, largest: float) -> str:
    """Return the number with its sign, to three digits of the largest one, without an exponent."""
    decimals = max(0, 2 - math.floor(math.log10(largest))) if largest > 0 else 0
    text = f"{value:+.{decimals}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _label_dot_px(panel: Panel) -> int:
    return math.ceil(_CONSTANTS.lenses_per_label_dot * panel.line_number / 3)


def _band_count(panel: Panel, bands: int | None, upright: bool) -> int:
    if bands is not None:
        count = whole_number("bands", bands, 3, 99)
        if count % 2 == 0:
            raise InputError(f"bands: expected an odd number, so that one is unchanged, got {count}")
        return count
    fitting_dots = (
        panel.width_px // width_dots(_CONSTANTS.label_characters) if upright else panel.height_px // HEIGHT_DOTS
    )
    fitting = min(_CONSTANTS.most_bands, fitting_dots // _label_dot_px(panel))
    return max(3, fitting - (fitting + 1) % 2)


def _label(band: np.ndarray, text: str, panel: Panel) -> None:
    """Write a text into the band's upper left corner, the same for all views, as large as fits up to 4 lenses a dot."""
    fitting_dots = min(band.shape[0] // HEIGHT_DOTS, band.shape[1] // width_dots(len(text)))
    mask = text_pixels(
        text, max(1, min(fitting_dots, math.ceil(_CONSTANTS.largest_dot_lenses * panel.line_number / 3)))
    )[: band.shape[0], : band.shape[1]]
    band[: mask.shape[0], : mask.shape[1]] = 255 * mask[..., None]
