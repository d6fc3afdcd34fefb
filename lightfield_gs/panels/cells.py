"""Sub-pixel cells: panels whose red, green and blue do not lie side by side, a third of a pixel each.

Looking Glass panels of the third generation have red and green in one row and blue in another, mirrored from pixel to
pixel. Their calibrations say where each sub-pixel lies in its pixel, for a few kinds of pixels ("cells"), and which
pixel is of which kind. What a sub-pixel shows follows from where it lies: from D = 3 (j + x) + 3 (i - y) tan(slant) +
phase, with (x, y) its place in the cell, right and up, in pixels (a stripe has x = k / 3 and y = 0).
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lightfield_gs.base.checks import is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import CELL_ROWS, CELL_RULES

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel

PERIOD = 4  # every known pattern repeats after so many columns and rows
LENS_WIDTH = 1 << 64  # phases are whole numbers of 2^-64 lens widths, modulo one lens
_MOST_CELLS = PERIOD * PERIOD
_FARTHEST_PX = 8.0
Cell = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]  # (x, y) of red, green, blue

# Number of the cell of column x and row y by `cell_pattern`, CellPatternMode in a calibration. Of patterns 2 and 4
# published programs disagree: "unity" is the rule of the Unity plug-in, of older WebXR, and was checked by eye on a
# 16-inch display; "webxr" that of newer WebXR.
_UNITY = {
    0: lambda x, y: 0 * (x + y),
    1: lambda x, y: (x + y) % 2,
    2: lambda x, y: x % 2 + 0 * y,
    3: lambda x, y: (y + 2 * (x % 2)) % 4,
    4: lambda x, y: y % 2 + 0 * x,
}
_RULES = {"unity": _UNITY, "webxr": {**_UNITY, 2: lambda x, y: y % 4 + 0 * x, 4: lambda x, y: x % 2 + 0 * y}}
PATTERNS = tuple(_UNITY)


class CellTable(NamedTuple):
    """What the native lens takes, each [PERIOD, PERIOD, 3] by row, column and place k (left to right in D).

    phases: 2^-64 lens widths, uint64: beyond those of the stripe k of a lens that begins `shift` (2^-64 lens widths)
    or `shift_subpixels` later, which is the middle of what the sub-pixels need. channels: int64, image channel at k.
    """

    phases: np.ndarray
    channels: np.ndarray
    shift: int
    shift_subpixels: float


def checked_cells(cells: Any) -> tuple[Cell, ...]:
    """Cells as tuples of floats; raises InputError where they are no list of three pairs of numbers each."""
    if cells is None:
        return ()
    if not is_row(cells) or len(cells) > _MOST_CELLS:
        raise InputError(f"panel: subpixel_cells must be a list of at most {_MOST_CELLS} cells, got {shown(cells)}")
    return tuple(_checked_cell(number, cell) for number, cell in enumerate(cells))


def _checked_cell(number: int, cell: Any) -> Cell:
    where = f"panel: subpixel_cells[{number}]"
    if not is_row(cell, 3) or not all(is_row(place, 2) for place in cell):
        raise InputError(f"{where} must be [x, y] of red, green and blue, pixels, right and up; got {shown(cell)}")
    red, green, blue = (
        _checked_place(f"{where}, {name}", place) for name, place in zip(("red", "green", "blue"), cell)
    )
    return red, green, blue


def _checked_place(where: str, place: Any) -> tuple[float, float]:
    x, y = (real_number(where, value, -_FARTHEST_PX, _FARTHEST_PX) for value in place)
    return x, y


def check_pattern(panel: Panel) -> None:
    """Raises InputError for a pattern, rule or origin of rows that is not known, or asks for more cells than given."""
    for name, value, known in (
        ("cell_pattern", panel.cell_pattern, PATTERNS),
        ("cell_rule", panel.cell_rule, CELL_RULES),
        ("cell_rows", panel.cell_rows, CELL_ROWS),
    ):
        if isinstance(value, bool) or not isinstance(value, (int, str)) or value not in known:
            raise InputError(f"panel: {name} must be one of {', '.join(map(str, known))}, got {shown(value)}")
    if not panel.subpixel_cells:
        if (panel.cell_pattern, panel.cell_rule, panel.cell_rows) != (0, CELL_RULES[0], CELL_ROWS[0]):
            raise InputError(
                f"panel: cell_pattern {panel.cell_pattern}, {panel.cell_rule}, {panel.cell_rows} without "
                "subpixel_cells; give the cells, or leave the pattern out"
            )
        return
    if panel.subpixel_order != "RGB":
        raise InputError("panel: subpixel_cells say where each colour lies; leave subpixel_order out")
    wanted = int(cell_numbers(panel).max()) + 1
    if wanted > len(panel.subpixel_cells):
        raise InputError(
            f"panel: cell_pattern {panel.cell_pattern} ({panel.cell_rule}) needs {wanted} subpixel_cells, "
            f"got {len(panel.subpixel_cells)}"
        )


def cell_numbers(panel: Panel) -> np.ndarray:
    """The number of a pixel's cell, int [PERIOD, PERIOD] by row i mod PERIOD and column j mod PERIOD."""
    rows, columns = np.indices((PERIOD, PERIOD))
    y = rows if panel.cell_rows == "top" else (panel.height_px - 1 - rows) % PERIOD
    return _RULES[panel.cell_rule][panel.cell_pattern](columns, y)


def subpixel_offsets(panel: Panel) -> np.ndarray:
    """D less that of the pixel's first stripe, in sub-pixels, Fractions [PERIOD, PERIOD, 3] by row, column, channel."""
    if not panel.subpixel_cells:
        stripes = [Fraction(panel.place(channel)) for channel in range(3)]
        return np.broadcast_to(np.array(stripes, object), (PERIOD, PERIOD, 3))
    slant = Fraction(panel.slant_tan)
    cells = np.array(
        [[3 * Fraction(x) - 3 * slant * Fraction(y) for x, y in cell] for cell in panel.subpixel_cells], object
    )
    return cells[cell_numbers(panel)]


@lru_cache(maxsize=64)  # asked for in every frame
def subpixel_phases(panel: Panel) -> np.ndarray:
    """What subpixel_offsets has, in 2^-64 lens widths, uint64, wrapping. Stripes are whole multiples of the sx that
    Panel.phase_steps returns."""
    if not panel.subpixel_cells:
        step = panel.phase_steps()[1]
        return np.array([panel.place(channel) * step % LENS_WIDTH for channel in range(3)], np.uint64) + np.zeros(
            (PERIOD, PERIOD, 1), np.uint64
        )
    per_subpixel = LENS_WIDTH / Fraction(panel.line_number)
    # Rounded up, as all phases are
    exact = np.frompyfunc(lambda offset: -(-offset * per_subpixel // 1) % LENS_WIDTH, 1, 1)
    return exact(subpixel_offsets(panel)).astype(np.uint64)


@lru_cache(maxsize=64)
def cell_table(panel: Panel) -> CellTable:
    """What the native lens takes of a panel with cells."""
    offsets = subpixel_offsets(panel)
    channels = np.argsort(offsets.astype(np.float64), axis=-1, kind="stable")
    beyond = np.take_along_axis(offsets, channels, -1) - np.arange(3)  # the stripe at the same place
    shift = (beyond.min() + beyond.max()) / 2
    whole = round(shift * LENS_WIDTH / Fraction(panel.line_number)) % LENS_WIDTH
    step = panel.phase_steps()[1]
    stripes = np.array([(k * step + whole) % LENS_WIDTH for k in range(3)], np.uint64)
    phases = np.take_along_axis(subpixel_phases(panel), channels, -1) - stripes
    return CellTable(phases, channels, whole, float(shift))
