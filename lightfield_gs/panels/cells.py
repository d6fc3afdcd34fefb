"""Sub-pixel cells: panels whose red, green and blue do not lie side by side, a third of a pixel each.

Looking Glass panels of the third generation have red and green in one row and blue in another, mirrored from pixel to
pixel. Their calibrations give the position of each sub-pixel in its pixel, for a few kinds of pixels ("cells"), and the
kind of each pixel. A sub-pixel at (x, y) in its cell, right and up, in pixels, has the lens coordinate
D = 3 (j + x) + 3 (i - y) tan(slant) + phase. A stripe has x = k / 3 and y = 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lightfield_gs.base.checks import is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CellRows, CellRule

PERIOD = 4  # every known pattern repeats after so many columns and rows
_MOST_CELLS = PERIOD * PERIOD
_FARTHEST_PX = 8.0
Cell = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]  # (x, y) of red, green, blue

# Number of the cell of column x and row y by `cell_pattern`, CellPatternMode in a calibration. Published programs
# disagree on patterns 2 and 4. "unity" is the rule of the Unity plug-in and of older WebXR, checked by eye on a 16-inch
# display. "webxr" is the rule of newer WebXR.
_UNITY = {
    0: lambda x, y: 0 * (x + y),
    1: lambda x, y: (x + y) % 2,
    2: lambda x, y: x % 2 + 0 * y,
    3: lambda x, y: (y + 2 * (x % 2)) % 4,
    4: lambda x, y: y % 2 + 0 * x,
}
_RULES = {"unity": _UNITY, "webxr": {**_UNITY, 2: lambda x, y: y % 4 + 0 * x, 4: lambda x, y: x % 2 + 0 * y}}
PATTERNS = tuple(_UNITY)


def checked_cells(cells: Any) -> tuple[Cell, ...]:
    """Return cells as tuples of floats.

    Raises:
        InputError: They are no list of three pairs of numbers each.
    """
    if cells is None:
        return ()
    if not is_row(cells) or len(cells) > _MOST_CELLS:
        raise InputError(f"panel: subpixel_cells must be a list of at most {_MOST_CELLS} cells, got {shown(cells)}")
    return tuple(_checked_cell(number, cell) for number, cell in enumerate(cells))


def _checked_cell(number: int, cell: Any) -> Cell:
    where = f"panel: subpixel_cells[{number}]"
    if not is_row(cell, 3) or not all(is_row(position, 2) for position in cell):
        raise InputError(f"{where} must be [x, y] of red, green and blue, pixels, right and up; got {shown(cell)}")
    red, green, blue = (
        _checked_position(f"{where}, {name}", position) for name, position in zip(("red", "green", "blue"), cell)
    )
    return red, green, blue


def _checked_position(where: str, position: Any) -> tuple[float, float]:
    x, y = (real_number(where, value, -_FARTHEST_PX, _FARTHEST_PX) for value in position)
    return x, y


def cell_numbers(pattern: int, rule: CellRule, rows_from: CellRows, height_px: int) -> np.ndarray:
    """Return the number of each pixel's cell, int [PERIOD, PERIOD], by row i mod PERIOD and column j mod PERIOD.

    Args:
        pattern: Panel.cell_pattern, one of PATTERNS.
        rule: Panel.cell_rule.
        rows_from: Panel.cell_rows, the edge that rows are counted from.
        height_px: Height of the panel in pixels.
    """
    rows, columns = np.indices((PERIOD, PERIOD))
    y = rows if rows_from == "top" else (height_px - 1 - rows) % PERIOD
    return _RULES[rule][pattern](columns, y)
