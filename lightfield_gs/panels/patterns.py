"""Native images that show how well a profile fits its panel: an eye before them sees which view reaches it.

All are uint8 [H, W, 3], drawn for the sub-pixels that `panel` says show a view. Those whose parameter varies over
bands are in lightfield_gs.panels.pattern_fans.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.checks import expect, whole_number
from lightfield_gs.panels.cells import PERIOD, subpixel_phases
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.pattern_text import HEIGHT_DOTS, text_dots, width_dots

_ROWS_PER_CHUNK = 64
# A lens lights about one sub-pixel; a number that is right on so many of them covers five sixths of what an eye sees.
_SUBPIXELS_PER_NUMBER = 1.2
_NUMBERS_ACROSS = 5
_LENSES_PER_DOT = 2  # at least, so that a dot of a digit cannot fall between the samples
_HUE_SPAN = 5 / 6  # from red to magenta, so that the two ends of the cone look different
BAR_MEAN, BAR_AMPLITUDE = 0.5, 0.45  # of the light of bars: neither black, nor so bright that a camera clips

Shade = Callable[[np.ndarray, slice], np.ndarray]


def lens_phases(panel: Panel, rows: slice, columns: slice) -> np.ndarray:
    """Lens phases uint64 [rows, columns, 3], indexed by image channel, as Panel.phase_rows has them of whole rows."""
    s0, sx, sy = (np.uint64(step) for step in panel.phase_steps())
    i, j = np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop)
    start = s0 + sy * i.astype(np.uint64)[:, None] + sx * (3 * j).astype(np.uint64)
    return start[..., None] + subpixel_phases(panel)[(i % PERIOD)[:, None], j % PERIOD]


def draw(panel: Panel, shade: Shade, rows: slice | None = None, columns: slice | None = None) -> np.ndarray:
    """uint8 [rows, columns, 3] (default: the whole panel) of what shade(x, part) makes of views x in [0, N).

    x: float64 [part, columns, 3]; part: the rows of the panel that it is of. The shade is 0..1, or bool.
    """
    rows, columns = rows or slice(0, panel.height_px), columns or slice(0, panel.width_px)
    out = np.empty((rows.stop - rows.start, columns.stop - columns.start, 3), np.uint8)
    for first in range(rows.start, rows.stop, _ROWS_PER_CHUNK):
        part = slice(first, min(first + _ROWS_PER_CHUNK, rows.stop))
        values = shade(panel.view_position(lens_phases(panel, part, columns)), part)
        out[part.start - rows.start : part.stop - rows.start] = np.rint(255.0 * values)
    return out


def hues(share: np.ndarray) -> np.ndarray:
    """Of each channel's own hue the part that is this channel, 0..1: [..., 3].

    share: [..., 3], 0 for red, over green and blue to 1 for magenta.
    """
    # A channel is 1 within a sixth of the circle of its primary, and falls linearly over the next sixth
    turns = share * _HUE_SPAN - np.arange(3) / 3
    return np.clip(2 - 6 * np.abs(turns - np.round(turns)), 0, 1)


def sweep(panel: Panel, hue: bool = True) -> np.ndarray:
    """Every view in one colour all over: a hue, red (view 0) to magenta (view N - 1), or a grey, black to white.

    An eye at the viewing distance sees the panel in one colour; another profile makes bands of it.
    """
    last = max(1, panel.views - 1)
    return draw(panel, lambda x, _: hues(np.floor(x) / last) if hue else np.floor(x) / last)


def number_of_view(panel: Panel, step: int | None = None) -> np.ndarray:
    """The number that each view shows in `numbers`, int [N].

    A lens lights about one sub-pixel, which on many panels spans several views: 10 of 96 where line_number is 9.8.
    Their numbers would overlay each other, so that neighbours show the number of the one in their middle.
    step: how many of them, 1..N; None: as many as an eye cannot tell apart (1.2 sub-pixels). Raises InputError.
    """
    expect("panel", panel, Panel)
    if step is None:
        step = min(panel.views, math.ceil(_SUBPIXELS_PER_NUMBER * panel.views / panel.line_number))
    groups = panel.views // whole_number("step", step, 1, panel.views)
    group = np.arange(panel.views) * groups // panel.views
    first, after = (np.searchsorted(group, np.arange(groups), side) for side in ("left", "right"))
    return ((first + after - 1) // 2)[group]


def numbers(panel: Panel, step: int | None = None) -> np.ndarray:
    """The picture of each view shows its own number, white on black, large and repeated over the panel.

    Views are numbered as in Panel: 0 for the right-most eye, unless invert_views. step: see number_of_view.
    """
    shown_by_view = number_of_view(panel, step)
    different, which = np.unique(shown_by_view, return_inverse=True)
    tiles, (down, across) = _number_tiles(panel, different)

    def shade(x: np.ndarray, part: slice) -> np.ndarray:
        i, inside_down = down
        j, inside_across = across
        inside = inside_down[part, None, None] & inside_across[:, None]
        return tiles[which[x.astype(np.int64)], i[part, None, None], j[:, None]] & inside  # 0 or 1

    return draw(panel, shade)


def number_picture(panel: Panel, number: int, step: int | None = None) -> np.ndarray:
    """Where the picture of the views that show this number in `numbers` is white: bool [H, W]."""
    different = np.unique(number_of_view(panel, step))
    tiles, (down, across) = _number_tiles(panel, different)
    tile = tiles[np.searchsorted(different, number)]
    return tile[np.ix_(down[0], across[0])] & down[1][:, None] & across[1]


_Tiling = tuple[np.ndarray, np.ndarray]  # for each row (column): the dot of the tile, and whether a whole tile is there


def _number_tiles(panel: Panel, different: np.ndarray) -> tuple[np.ndarray, tuple[_Tiling, _Tiling]]:
    """A tile for each number, bool [count, h, w] in dots, and how tiles lie along rows and columns."""
    digits = len(str(different.max()))
    size, dots = (panel.height_px, panel.width_px), (HEIGHT_DOTS, width_dots(digits))
    largest = max(1, min(full // part for full, part in zip(size, dots)))
    least = math.ceil(_LENSES_PER_DOT * panel.line_number / 3)
    dot_px = min(largest, max(least, size[1] // (_NUMBERS_ACROSS * dots[1])))
    tiles = np.stack([text_dots(str(number).rjust(digits)) for number in different])
    down, across = (_tiling(full, part, dot_px) for full, part in zip(size, dots))
    return tiles, (down, across)


def _tiling(size_px: int, tile_dots: int, dot_px: int) -> _Tiling:
    """Whole tiles in the middle of so many pixels, one even where it is cut."""
    tile_px = tile_dots * dot_px
    covered = max(1, size_px // tile_px) * tile_px
    place = np.arange(size_px) + (covered - size_px) // 2
    return place % tile_px // dot_px, (place >= 0) & (place < covered)


def single(panel: Panel, first: int, last: int | None = None) -> np.ndarray:
    """View `first` white (views first..last, both included), all others black. Raises InputError."""
    first = whole_number("view", first, 0, panel.views - 1)
    last = first if last is None else whole_number("last view", last, first, panel.views - 1)
    return draw(panel, lambda x, _: (x >= first) & (x < last + 1))


def bars(panel: Panel, shift: int | None = None) -> np.ndarray:
    """Light that is a cosine of the view: 0.5 + 0.45 cos(2 pi (x/N - shift/3)), coded as sRGB. For calibration_fit.

    shift: 0, 1 or 2, in grey; None: red has shift 0, green 1 and blue 2, all in one image. Raises InputError.
    """
    shifts = np.arange(3) if shift is None else whole_number("shift", shift, 0, 2)
    turn = 2 * math.pi

    def shade(x: np.ndarray, _: slice) -> np.ndarray:
        return encode_srgb(BAR_MEAN + BAR_AMPLITUDE * np.cos(turn * (x / panel.views - shifts / 3)))

    return draw(panel, shade)
