"""How well views join: what lies side by side among cameras looks alike, and what does not tells another order."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lightfield_gs.io.images import as_floats

_SMALL_PX = 96  # a side at most that views are compared at, so that fine texture does not count
_APART = 2.0  # times the difference of neighbours, above which there is a jump
_LEAST_DIFFERENCE = 0.2 / 255  # of neighbours: views that hardly differ tell nothing


def small(pixels: np.ndarray) -> np.ndarray:
    """Means of a view [H, W, 3] over squares, float32 [h, w, 3]."""
    height, width = pixels.shape[:2]
    each = max(1, -(-max(height, width) // _SMALL_PX))
    rows, columns = max(1, height // each), max(1, width // each)
    part = as_floats(pixels[: rows * each, : columns * each])
    return part.reshape(rows, min(each, height), columns, min(each, width), -1).mean((1, 3))


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).mean())


def rows_join_otherwise(tile: Callable[[int, int], np.ndarray], columns: int, rows: int) -> bool:
    """Whether views jump from row to row as they are taken, and would not with the rows in the other order.

    tile: the pixels of a row and a column, as the views go: along a row, then on to the next row.
    """
    if columns < 2 or rows < 2:
        return False
    along, onwards, back = [], [], []
    ends: tuple[np.ndarray, np.ndarray] | None = None
    for row in range(rows):
        first, second, last = (small(tile(row, column)) for column in (0, 1, columns - 1))
        along.append(_apart(first, second))
        if ends is not None:
            onwards.append(_apart(ends[1], first))
            back.append(_apart(last, ends[0]))
        ends = first, last
    usual = max(float(np.mean(along)), _LEAST_DIFFERENCE)
    return min(onwards) > _APART * max(usual, *back)


def looks_like_rows(view: Callable[[int], np.ndarray], side: int) -> bool:
    """Whether pictures of a row jump after each `side` of them, as the rows of a grid of side x side cameras do."""
    start, before, end, then, after = pictures = [small(view(k)) for k in (0, side - 2, side - 1, side, side + 1)]
    if len({picture.shape for picture in pictures}) > 1:
        return False
    usual = max(_apart(before, end), _apart(then, after), _LEAST_DIFFERENCE)
    return _apart(end, then) > _APART * usual and _apart(start, then) < _apart(end, then) / _APART


def goes_back(views: Sequence[np.ndarray]) -> bool:
    """Whether the second half of these views [h, w, 3] shows the first half again, from the end, as animations do that
    go to and fro."""
    count = len(views)
    usual = max(float(np.mean([_apart(*pair) for pair in zip(views, views[1:])])), _LEAST_DIFFERENCE)
    for last in (count - 1, count):  # with the first frame again at the end, or not
        pairs = [(k, last - k) for k in range(last - count + 1, count // 2) if k < last - k]
        if len(pairs) > 1 and all(_apart(views[one], views[other]) * _APART < usual for one, other in pairs):
            return True
    return False
