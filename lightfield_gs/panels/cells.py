"""Sub-pixel cells: panels whose red, green and blue do not lie side by side, a third of a pixel each.

Looking Glass panels of the third generation have red and green in one row and blue in another, mirrored from pixel to
pixel. Their calibrations give the position of each sub-pixel in its pixel, for a few kinds of pixels ("cells"), and the
kind of each pixel. A sub-pixel at (x, y) in its cell, right and up, in pixels, has the lens coordinate
D = 3 (j + x) + 3 (i - y) tan(slant) + phase. A stripe has x = k / 3 and y = 0.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lightfield_gs.base.checks import is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CellRows, CellRule

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel

LENS_WIDTH = 1 << 64  # phases are whole numbers of 2^-64 lens widths, modulo one lens
PERIOD = 4  # every known pattern repeats after this number of columns and rows
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


def subpixel_offsets(panel: Panel) -> np.ndarray:
    """Return D of sub-pixels less D of the first stripe, Fractions [PERIOD, PERIOD, 3] by row, column, channel."""
    if not panel.subpixel_cells:
        stripes = [Fraction(panel.stripe_index(channel)) for channel in range(3)]
        return np.broadcast_to(np.array(stripes, object), (PERIOD, PERIOD, 3))
    slant = Fraction(panel.slant_tan)
    offsets = np.array(
        [[3 * Fraction(x) - 3 * slant * Fraction(y) for x, y in cell] for cell in panel.subpixel_cells], object
    )
    return offsets[cell_numbers(panel.cell_pattern, panel.cell_rule, panel.cell_rows, panel.height_px)]


@lru_cache(maxsize=64)  # asked for in every frame
def subpixel_phases(panel: Panel) -> np.ndarray:
    """Return `subpixel_offsets` in 2^-64 lens widths, uint64, wrapping.

    Stripes have whole multiples of the step sx of Panel.phase_steps.
    """
    if not panel.subpixel_cells:
        step = panel.phase_steps()[1]
        phases = [panel.stripe_index(channel) * step % LENS_WIDTH for channel in range(3)]
        return np.array(phases, np.uint64) + np.zeros((PERIOD, PERIOD, 1), np.uint64)
    per_subpixel = LENS_WIDTH / Fraction(panel.line_number)
    # Rounded up, as all phases are
    exact = np.frompyfunc(lambda offset: -(-offset * per_subpixel // 1) % LENS_WIDTH, 1, 1)
    return exact(subpixel_offsets(panel)).astype(np.uint64)


class CellTable(NamedTuple):
    """Phases and channels of the sub-pixels of a panel with cells, as the native lens takes them.

    Each array is [PERIOD, PERIOD, 3], by row, column and rank k, left to right in D.

    Attributes:
        phases: uint64, 2^-64 lens widths, beyond the phases of stripe k of a lens that begins `shift` later.
        channels: int64, the image channel at k.
        shift: 2^-64 lens widths, the middle of the sub-pixels' shifts.
        shift_subpixels: The same in sub-pixels.
    """

    phases: np.ndarray
    channels: np.ndarray
    shift: int
    shift_subpixels: float


@lru_cache(maxsize=64)
def cell_table(panel: Panel) -> CellTable:
    """Return the cell table of a panel with cells."""
    offsets = subpixel_offsets(panel)
    channels = np.argsort(offsets.astype(np.float64), axis=-1, kind="stable")
    beyond = np.take_along_axis(offsets, channels, -1) - np.arange(3)  # the stripe of the same rank
    shift = (beyond.min() + beyond.max()) / 2
    whole = round(shift * LENS_WIDTH / Fraction(panel.line_number)) % LENS_WIDTH
    step = panel.phase_steps()[1]
    stripes = np.array([(k * step + whole) % LENS_WIDTH for k in range(3)], np.uint64)
    phases = np.take_along_axis(subpixel_phases(panel), channels, -1) - stripes
    return CellTable(phases, channels, whole, float(shift))
