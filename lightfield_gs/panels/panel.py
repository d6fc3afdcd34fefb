"""A slanted-lenticular panel: which of its views every sub-pixel shows.

A sub-pixel is at row i from the top, column j and stripe k of its pixel from the left, all 0-based. Then (Shi et al.,
Photonics 2025, 12(3), 279, section 3; van Berkel 1999)
    D = 3 j + 3 i tan(slant) + k + phase            x = N frac(D / line_number)            n = floor(x)
evaluated in wrapping 64-bit fixed point, so that every implementation agrees bit for bit. Panels whose sub-pixels do
not stand in stripes: see lightfield_gs.panels.cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass, fields
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import lightfield_gs
from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import check_fields, checked_field, expect, real_number, shown, whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.base.options import (
    CELL_ROWS,
    CELL_RULES,
    DEFAULT_CONE_DEG,
    SUBPIXEL_ORDERS,
    CellRows,
    CellRule,
    SubpixelOrder,
)
from lightfield_gs.io.text_files import config_path, read_mapping, write_mapping
from lightfield_gs.panels.cells import (
    LENS_WIDTH,
    PATTERNS,
    PERIOD,
    Cell,
    cell_numbers,
    cell_table,
    checked_cells,
    subpixel_phases,
)
from lightfield_gs.panels.display_kinds import DISPLAY_KINDS
from lightfield_gs.panels.looking_glass import panel_fields
from lightfield_gs.rasterizer.lenticular_camera import Lens

MAX_SIZE_PX = 65536
MAX_VIEWS = 65536
_LOOKING_GLASS_VIEWS = 96  # a calibration does not say into how many views its lens divides
STRIPES: tuple[Cell, ...] = ()  # the sub-pixel cells of a panel that has none


@lru_cache(maxsize=64)  # asked for in every frame
def _phase_steps(line_number: float, slant_tan: float, phase: float) -> tuple[int, int, int]:
    lens, down, start = Fraction(line_number), 3 * Fraction(slant_tan), Fraction(phase)
    steps = (start, Fraction(1), down)
    first, across, below = (math.ceil(LENS_WIDTH * step / lens) % LENS_WIDTH for step in steps)
    return first, across, below


@dataclass(frozen=True)
class Panel:
    """Geometry of a panel and its lens.

    Attributes:
        width_px: Whole pixels, 1..65536.
        height_px: Whole pixels, 1..65536.
        views: Number N of views behind a lens, 1..65536.
        line_number: P_e, width of a lens along a row, in sub-pixels, > 0.
        slant_tan: Tangent of the angle between lens axis and columns; positive leans like "/".
        phase: D_0, position of the panel's first sub-pixel against the lens edge, in sub-pixels.
        subpixel_order: "RGB" or "BGR", left to right.
        invert_views: True if view 0 goes to the left-most eye, not to the right-most one.
        cone_deg: Full angle that the N views span, in (0, 180).
        viewing_distance_mm: Eye to lens, > 0, or None when not known.
        pixel_pitch_mm: Width (and height) of a pixel, > 0, or None when not known.
        name: For messages and metadata.
        subpixel_cells: () for stripes, or for each kind of pixel the three positions (x, y) of red, green and blue.
            They are in pixels, right and up, from the point that `phase` is measured at (Looking Glass: the pixel's
            centre).
        cell_pattern: The kind of a pixel in column x and row y, Looking Glass' CellPatternMode. 0: all of kind 0; 1: (x
            + y) mod 2; 2: x mod 2; 3: (y + 2 (x mod 2)) mod 4; 4: y mod 2.
        cell_rule: "unity", the patterns above; or "webxr", where 2 is y mod 4 and 4 is x mod 2. Published programs
            disagree.
        cell_rows: "bottom" or "top", the edge that y counts from.

    Raises:
        InputError: A value is out of its range.
    """

    width_px: int = checked_field(whole_number, 1, MAX_SIZE_PX)
    height_px: int = checked_field(whole_number, 1, MAX_SIZE_PX)
    views: int = checked_field(whole_number, 1, MAX_VIEWS)
    line_number: float = checked_field(real_number, 1e-3, 1e6)
    slant_tan: float = checked_field(real_number, -10, 10)
    phase: float = checked_field(real_number, -1e12, 1e12, default=0.0)
    subpixel_order: SubpixelOrder = "RGB"
    invert_views: bool = False
    cone_deg: float = checked_field(real_number, 1e-6, 180, default=DEFAULT_CONE_DEG)
    viewing_distance_mm: float | None = checked_field(real_number, 1e-3, 1e9, default=None)
    pixel_pitch_mm: float | None = checked_field(real_number, 1e-6, 1e6, default=None)
    name: str = "panel"
    subpixel_cells: tuple[Cell, ...] = STRIPES
    cell_pattern: int = 0
    cell_rule: CellRule = "unity"
    cell_rows: CellRows = "bottom"

    def __post_init__(self) -> None:
        check_fields(self, "panel: ")
        if self.cone_deg >= 180:
            raise InputError(f"panel: cone_deg must be below 180, got {self.cone_deg}")
        if not isinstance(self.subpixel_order, str) or self.subpixel_order not in SUBPIXEL_ORDERS:
            raise InputError(f"panel: subpixel_order must be RGB or BGR, got {shown(self.subpixel_order)}")
        if not isinstance(self.invert_views, bool):
            raise InputError(f"panel: invert_views must be true or false, got {shown(self.invert_views)}")
        object.__setattr__(self, "name", str(self.name))
        if self.subpixel_cells is not STRIPES:
            object.__setattr__(self, "subpixel_cells", checked_cells(self.subpixel_cells))
        self._check_cells()

    def _check_cells(self) -> None:
        """Raise InputError for an unknown pattern, rule or origin of rows, or for too few cells."""
        for name, value, known in (
            ("cell_pattern", self.cell_pattern, PATTERNS),
            ("cell_rule", self.cell_rule, CELL_RULES),
            ("cell_rows", self.cell_rows, CELL_ROWS),
        ):
            if isinstance(value, bool) or not isinstance(value, (int, str)) or value not in known:
                raise InputError(f"panel: {name} must be one of {', '.join(map(str, known))}, got {shown(value)}")
        pattern = self.cell_pattern, self.cell_rule, self.cell_rows
        if not self.subpixel_cells:
            if pattern != (0, CELL_RULES[0], CELL_ROWS[0]):
                raise InputError(
                    f"panel: cell_pattern {', '.join(map(str, pattern))} without subpixel_cells; give the cells, or "
                    "leave the pattern out"
                )
            return
        if self.subpixel_order != "RGB":
            raise InputError("panel: subpixel_cells say where each colour lies; leave subpixel_order out")
        wanted = int(cell_numbers(*pattern, self.height_px).max()) + 1
        if wanted > len(self.subpixel_cells):
            raise InputError(
                f"panel: cell_pattern {self.cell_pattern} ({self.cell_rule}) needs {wanted} subpixel_cells, "
                f"got {len(self.subpixel_cells)}"
            )

    def _repr_html_(self) -> str:
        """Return the picture that a notebook shows."""
        return lightfield_gs.NotebookPicture.of_panel(self)._repr_html_()

    # Sources of panels

    @staticmethod
    def load(source: str | Path, *, serial: str | None = None) -> Panel:
        """Return a panel by name, from a YAML file, or from a Looking Glass calibration (.json).

        Args:
            source: The path, or a name: of configs/panels, or of a kind of Looking Glass (DISPLAY_KINDS), whose typical
                lens is then taken.
            serial: The display, where the file has calibrations of several (see from_looking_glass).

        Raises:
            InputError: The panel cannot be read.
        """
        expect("panel", source, str, Path)
        if str(source).lower().endswith(".json"):
            return Panel.from_looking_glass(source, serial=serial)
        if serial is not None:
            raise InputError(
                f"serial= chooses among Looking Glass calibrations in a .json "
                f"file, and {shown(str(source))} is none; leave it out"
            )
        if str(source) in DISPLAY_KINDS and not Path(source).is_file():
            return Panel._typical(str(source))
        return Panel.from_yaml(source)

    @staticmethod
    def _typical(name: str) -> Panel:
        """Return the panel of a kind of display, with its typical lens."""
        kind = DISPLAY_KINDS[name]
        lens = "" if kind.lens.is_measured else ", assumed from another kind"
        assume(
            f"panel {name}: the lens of a typical {kind.title}{lens}; every display has one of its own, and only its "
            "visual.json gives right views on it (`lightfield-gs displays` finds it)"
        )
        return Panel(**{**kind.fields(_LOOKING_GLASS_VIEWS), "name": name})

    @staticmethod
    def from_yaml(source: str | Path) -> Panel:
        """Return a panel from a YAML file with the fields of this class, or by a name in configs/panels.

        Raises:
            InputError: The file cannot be read, has an unknown key, or lacks a key.
        """
        expect("panel", source, str, Path)
        text = str(source)
        is_file = (
            text.lower().endswith((".yaml", ".yml")) or "/" in text or len(Path(text).parts) > 1 or Path(text).is_file()
        )
        path = Path(source) if is_file else config_path("panels", text, tuple(DISPLAY_KINDS))
        required = ("width_px", "height_px", "views", "line_number", "slant_tan")
        data = read_mapping(path, required, [f.name for f in fields(Panel) if f.name not in required])
        return Panel._of_file(path, {"name": path.stem, **data})

    @staticmethod
    def from_physical(
        *,
        width_px: int,
        height_px: int,
        views: int,
        lens_pitch_mm: float,
        slant_tan: float,
        viewing_distance_mm: float,
        lens_gap_mm: float,
        pixel_pitch_mm: float,
        phase: float = 0.0,
        subpixel_order: SubpixelOrder = "RGB",
        invert_views: bool = False,
        cone_deg: float | None = None,
        name: str = "panel",
    ) -> Panel:
        """Return a panel from its measures in mm.

        Source: Shi et al. 2025, P_e = (L + L_g)/L * P_l / (cos(theta) p_sub). The paper omits p_sub, the width of a
        sub-pixel, a third of pixel_pitch_mm.

        Args:
            width_px: See Panel.
            height_px: See Panel.
            views: See Panel.
            lens_pitch_mm: P_l, across the lens axis.
            slant_tan: See Panel.
            viewing_distance_mm: L, see Panel.
            lens_gap_mm: L_g, air-equivalent distance of lens and sub-pixels.
            pixel_pitch_mm: See Panel.
            phase: See Panel.
            subpixel_order: See Panel.
            invert_views: See Panel.
            cone_deg: See Panel; None: it follows from the gap.
            name: See Panel.

        Raises:
            InputError: A value is out of its range.
        """
        pitch, gap, distance, pixel = (
            real_number(f"panel: {key}", value, 1e-6, 1e9)
            for key, value in (
                ("lens_pitch_mm", lens_pitch_mm),
                ("lens_gap_mm", lens_gap_mm),
                ("viewing_distance_mm", viewing_distance_mm),
                ("pixel_pitch_mm", pixel_pitch_mm),
            )
        )
        slant = real_number("panel: slant_tan", slant_tan, -10, 10)
        lens_width = (distance + gap) / distance * pitch / math.cos(math.atan(slant))  # in mm along a row
        if cone_deg is None:
            cone_deg = 2 * math.degrees(math.atan(lens_width / (2 * gap)))
        return Panel(
            width_px=width_px,
            height_px=height_px,
            views=views,
            line_number=lens_width / (pixel / 3),
            slant_tan=slant,
            phase=phase,
            subpixel_order=subpixel_order,
            invert_views=invert_views,
            cone_deg=cone_deg,
            viewing_distance_mm=distance,
            pixel_pitch_mm=pixel,
            name=name,
        )

    @staticmethod
    def from_looking_glass(
        source: str | Path | dict[str, Any] | list[Any],
        *,
        views: int = _LOOKING_GLASS_VIEWS,
        serial: str | None = None,
        flip_center: float = 0.0,
    ) -> Panel:
        """Return a panel from a Looking Glass calibration: visual.json, or the answer of Looking Glass Bridge.

        Args:
            source: The path, or the parsed content. Its values may be plain or {"value": v}; numbers may be strings.
            views: See Panel.
            serial: Serial number of the calibration or the display; needed where there are several.
            flip_center: Lens widths that `center` gains where flipImageX is set; programs disagree whether 0 or 0.5.

        Raises:
            InputError: A value is missing or invalid, or describes optics that are not known here.
        """
        return Panel._of_file(source, panel_fields(source, views, serial, flip_center))

    @staticmethod
    def _of_file(source: object, data: dict[str, Any]) -> Panel:
        """Return a panel of these fields; an error names the file."""
        with named(source) if isinstance(source, (str, Path)) else nullcontext():
            return Panel(**data)

    def to_dict(self) -> dict[str, Any]:
        """Return the known fields as from_yaml reads them; the fields of cells only if the panel has cells."""
        stripes = () if self.subpixel_cells else ("subpixel_cells", "cell_pattern", "cell_rule", "cell_rows")
        return {key: value for key, value in asdict(self).items() if value is not None and key not in stripes}

    def to_yaml(self, path: str | Path) -> None:
        """Write the panel as from_yaml reads it, every digit kept."""
        write_mapping(path, self.to_dict())

    # Lens phase

    def phase_steps(self) -> tuple[int, int, int]:
        """Return (s0, sx, sy), integers mod 2^64: sub-pixel (i, j, k) has the phase s0 + sx (3 j + k) + sy i.

        On a panel with cells, s0 + 3 sx j + sy i is the phase of a pixel; subpixel_phases has the offsets of its
        sub-pixels.

        The unit is 2^-64 lens widths; steps are computed exactly and rounded up. So a sub-pixel exactly on the border
        of two views (line_number a whole number, say) falls on the upper view, as floor() demands. The sum is less than
        2^-45 lens widths too large.
        """
        return _phase_steps(self.line_number, self.slant_tan, self.phase)

    def stripe_index(self, channel: int) -> int:
        """Return the stripe k, left to right, of image channel 0, 1, 2 (red, green, blue) in a pixel of stripes."""
        return channel if self.subpixel_order == "RGB" else 2 - channel

    def phase_rows(self, rows_per_chunk: int = 64) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield chunks of rows and their lens phases uint64 [rows, W, 3], indexed by image channel."""
        s0, sx, sy = (np.uint64(step) for step in self.phase_steps())
        columns, within = np.arange(self.width_px, dtype=np.uint64), subpixel_phases(self)
        across = sx * (3 * columns[:, None]) + within[:, np.arange(self.width_px) % PERIOD]
        for first in range(0, self.height_px, rows_per_chunk):
            numbers = np.arange(first, min(first + rows_per_chunk, self.height_px))
            down = s0 + sy * numbers.astype(np.uint64)
            yield slice(first, first + len(numbers)), down[:, None, None] + across[numbers % PERIOD]

    def view_map(self, continuous: bool = False) -> np.ndarray:
        """Return the view of every sub-pixel [H, W, 3], by image channel: n int32 in 0..N-1, or x float64 in [0, N)."""
        out = np.empty((self.height_px, self.width_px, 3), np.float64 if continuous else np.int32)
        for rows, phase in self.phase_rows():
            out[rows] = self.view_position(phase) if continuous else self.view_index(phase)
        return out

    def view_index(self, phase: np.ndarray) -> np.ndarray:
        """Return integer views n, int32, of lens phases uint64: the high word of phase * N."""
        views, half = np.uint64(self.views), np.uint64(32)
        low = (phase & np.uint64(0xFFFFFFFF)) * views >> half
        return ((phase >> half) * views + low >> half).astype(np.int32)

    def view_position(self, phase: np.ndarray) -> np.ndarray:
        """Return continuous views x in [0, N), float64, of lens phases uint64."""
        # The upper 53 bits convert exactly, so x cannot round up to N.
        return (phase >> np.uint64(11)).astype(np.float64) * (2.0**-53 * self.views)


def panel_lens(panel: Panel, continuous: bool = False, offset_start: float = 0.0, offset_step: float = 0.0) -> Lens:
    """Return the panel's lens before a row of cameras.

    Args:
        panel: The panel.
        continuous: Whether sub-pixels see the view at x itself, not the nearest integer view.
        offset_start: Offset of the camera of view 0, scene units.
        offset_step: Offset from view to view, scene units.
    """
    start, across, down = panel.phase_steps()
    phase, phases, channels = panel.phase, (), ()
    if panel.subpixel_cells:
        table = cell_table(panel)
        start, phase = start + table.shift, phase + table.shift_subpixels
        phases, channels = (tuple(part.reshape(-1).tolist()) for part in (table.phases, table.channels))
    return Lens(
        panel.width_px,
        panel.height_px,
        panel.views,
        (start % LENS_WIDTH, across, down),
        float(panel.line_number),
        float(panel.slant_tan),
        float(phase),
        panel.subpixel_order == "BGR",
        continuous,
        float(offset_start),
        float(offset_step),
        phases,
        channels,
    )


def slow_reason(panel: Panel, lattices_on_cuda: bool) -> str | None:
    """Return why `direct` takes longer for a panel with sub-pixel cells; None where it does not.

    Args:
        panel: The panel.
        lattices_on_cuda: Whether a frame with lattices is drawn on CUDA.
    """
    if not panel.subpixel_cells:
        return None
    lens = panel_lens(panel).native()
    if not (lens.stands_in_order() and lens.has_one_order()):
        return (
            f"the sub-pixel cells of panel {panel.name} have no one order along the lens: it is drawn by slower "
            "ways, on the CPU a sub-pixel at a time, on CUDA by tiles of pixels, and without lattices"
        )
    if lattices_on_cuda:
        return "panels with sub-pixel cells are drawn without lattices on CUDA: this quality saves little time"
    return None
