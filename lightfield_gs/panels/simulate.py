"""The picture that an eye sees through the lenses of a panel."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from lightfield_gs.base.checks import expect, is_row, real_number, shown, whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.text_files import read_text
from lightfield_gs.panels.cells import PERIOD, subpixel_offsets
from lightfield_gs.panels.panel import Panel

_MOST_BYTES, _MOST_POINTS = 1 << 20, 4096
_MOST_SUBPIXELS, _MOST_LIGHT = 1e4, 1e12


@dataclass(frozen=True)
class Psf:
    """A measured spread of light: the brightness of the sub-pixels beside the sub-pixel behind the lens.

    Attributes:
        offsets: 2..4096 offsets in sub-pixels along a row, ascending. 0 is the sub-pixel that the eye sees exactly
            behind the lens; its right neighbour is at 1.
        light: Brightness at each offset, >= 0, in any unit; linear between the offsets, 0 beyond them.

    Raises:
        InputError: A value is out of its range.
    """

    offsets: tuple[float, ...]
    light: tuple[float, ...]

    def __post_init__(self) -> None:
        for name, limits in (("offsets", (-_MOST_SUBPIXELS, _MOST_SUBPIXELS)), ("light", (0.0, _MOST_LIGHT))):
            values = getattr(self, name)
            if not is_row(values) or not 2 <= len(values) <= _MOST_POINTS:
                raise InputError(f"psf: {name} must be 2..{_MOST_POINTS} numbers")
            object.__setattr__(self, name, tuple(real_number(f"psf: {name}", value, *limits) for value in values))
        if len(self.offsets) != len(self.light):
            raise InputError(f"psf: expected a light for each of {len(self.offsets)} offsets, got {len(self.light)}")
        if any(after <= before for before, after in zip(self.offsets, self.offsets[1:])):
            raise InputError("psf: offsets must ascend")
        if not max(self.light) > 0:
            raise InputError("psf: all light is 0, so that nothing would be seen")

    @staticmethod
    def load(path: str | Path) -> Psf:
        """Return a spread of light from a text file.

        Each line has an offset and its light, a comma or blanks between them; lines that begin with # are comments.

        Raises:
            InputError: The file cannot be read.
        """
        lines = read_text(path, _MOST_BYTES, "text of a spread of light").splitlines()
        rows = [(number, line.strip()) for number, line in enumerate(lines, 1)]
        with named(path):
            pairs = [_pair(number, line) for number, line in rows if line and not line.startswith("#")]
            return Psf(tuple(offset for offset, _ in pairs), tuple(light for _, light in pairs))

    def seen(self, offsets: np.ndarray, lens: float) -> np.ndarray:
        """Return the light of sub-pixels, float32, relative to the largest.

        The light of sub-pixels of other lenses within the table is added: the eye sees them at the same point of their
        own lens.

        Args:
            offsets: Offsets of the sub-pixels from the middle of their lenses.
            lens: Width of a lens in sub-pixels.
        """
        total = np.zeros(offsets.shape)
        low = math.ceil((self.offsets[0] - lens / 2) / lens)
        high = math.floor((self.offsets[-1] + lens / 2) / lens)
        for other in range(low, high + 1):
            total += np.interp(offsets + other * lens, self.offsets, self.light, left=0.0, right=0.0)
        return (total / max(self.light)).astype(np.float32)


def _pair(number: int, line: str) -> tuple[float, float]:
    """Return the two numbers of a line."""
    words: Sequence[str] = line.replace(",", " ").replace(";", " ").split()
    try:
        offset, light = (float(word) for word in words)
    except ValueError:
        raise InputError(f"line {number}: expected an offset in sub-pixels and its light, got {line[:40]!r}") from None
    return offset, light


FWHM_TO_SIGMA = 1 / (2 * math.sqrt(2 * math.log(2)))
SPREADS = 1e-2, 1e3  # the limits of spread_subpixels
_MOST_EYES = 1000
_ROWS_PER_CHUNK_PX = 8  # small temporaries stay in the cache
_CELL_ROWS_PER_CHUNK = 32  # rows of cells, for the same reason


def simulate(
    image: np.ndarray,
    panel: Panel,
    eye_mm: Sequence[float],
    spread_subpixels: float = 1.0,
    threads: int | None = None,
    psf: Psf | None = None,
) -> np.ndarray:
    """Return the picture that one eye perceives: float32 [round(3 H / P_e), round(3 W / P_e), 3], one sample a lens.

    The eye reaches the sub-pixel at xi = X - Y tan(theta) through the point a on its lens (docs/design.md, "What an eye
    sees"):
        a = D_mid/P_e + (xi z + xi_eye L_g) / ((z + L_g) p_h),   L_g = P_e p_sub L/E,   p_h = P_e p_sub L/(L + L_g)
    E = 2 L tan(cone/2). The sub-pixel is lit by a Gaussian of frac(a) - 1/2, or by the psf of P_e (frac(a) - 1/2)
    sub-pixels. The eye perceives the mean of the sub-pixels around, weighted by their light. At z = L the eye sees the
    view N (1/2 - xi_eye/E) everywhere. On a panel with invert_views the lens plane lies behind the pixels (L_g < 0), so
    that right eyes still see the cameras to the right.

    Args:
        image: The light-field image [H, W, 3 or 4] of this panel, uint8, uint16 or float; alpha is ignored.
        panel: The panel, with viewing_distance_mm and pixel_pitch_mm.
        eye_mm: (x, y, z) of the eye in mm from the panel's centre: x right, y up, z > 0 towards the viewer.
        spread_subpixels: Full width at half maximum of the light of a lens, > 0; more than 1 is crosstalk.
        threads: Number of threads; None: one a core.
        psf: A measured spread of light in place of the Gaussian.

    Raises:
        InputError: An argument is invalid, or the panel lacks a measure.
    """
    _check(image, panel)
    eye = checked_eye(eye_mm)
    spread = real_number("spread_subpixels", spread_subpixels, *SPREADS)
    expect("psf", psf, Psf, type(None))
    if psf is not None and spread != 1:
        raise InputError("spread_subpixels= is for the Gaussian, and psf= takes its place: leave out one of them")
    threads = os.cpu_count() if threads is None else whole_number("threads", threads, 1, 4096)
    lens, half_cone_tan = panel.line_number, math.tan(math.radians(panel.cone_deg) / 2)
    path = eye_path(panel, eye, lens, panel.slant_tan, panel.phase, half_cone_tan)
    columns, rows = cell_borders(panel.width_px, lens), cell_borders(panel.height_px, lens)
    lit = np.zeros((len(rows) - 1, len(columns) - 1, 3), np.float32)
    weight = np.zeros_like(lit)
    sigma = spread * FWHM_TO_SIGMA / lens
    cells_per_chunk = max(1, int(_ROWS_PER_CHUNK_PX * len(rows) / panel.height_px))
    along = [_turns_along(panel, channel, path) for channel in range(3)]

    def sum_up(first: int) -> None:
        bounds = rows[first : first + cells_per_chunk + 1]
        cells = slice(first, first + len(bounds) - 1)
        numbers = np.arange(bounds[0], bounds[-1])
        down = _fractions(path.slope * 3 * panel.slant_tan * numbers)[:, None]
        for channel in range(3):
            turns = along[channel][numbers % PERIOD] + down
            light = _light(turns, sigma) if psf is None else _measured_light(turns, psf, lens)
            weight[cells, :, channel] = _sums(light, bounds, columns)
            light *= image[bounds[0] : bounds[-1], :, channel]
            lit[cells, :, channel] = _sums(light, bounds, columns)

    scale = np.float32(1 / np.iinfo(image.dtype).max if np.issubdtype(image.dtype, np.integer) else 1.0)
    seen = np.empty_like(lit)

    def blur(first: int) -> None:
        cells = slice(first, min(first + _CELL_ROWS_PER_CHUNK, len(lit)))
        np.divide(scale * _blurred(lit, cells), _blurred(weight, cells), out=seen[cells])

    with ThreadPoolExecutor(threads) as pool:  # NumPy works outside the interpreter lock
        list(pool.map(sum_up, range(0, len(lit), cells_per_chunk)))
        list(pool.map(blur, range(0, len(lit), _CELL_ROWS_PER_CHUNK)))
    return seen


class EyePath(NamedTuple):
    """The point on its lens through which an eye reaches a sub-pixel: shift + slope (D - middle), in lens widths."""

    shift: Any
    slope: Any
    middle: Any


def eye_path(
    panel: Panel, eye_mm: tuple[float, float, float], line_number: Any, slant_tan: Any, phase: Any, half_cone_tan: Any
) -> EyePath:
    """Return how an eye reaches the sub-pixels of a panel, by the formulas of `simulate`.

    Args:
        panel: With viewing_distance_mm and pixel_pitch_mm.
        eye_mm: See simulate.
        line_number: Of the panel's lens, as the next two: floats or tensors.
        slant_tan: See Panel.
        phase: See Panel.
        half_cone_tan: The tangent of half the cone.

    Raises:
        InputError: The eye is too near.
    """
    (x, y, z), distance, sub_mm = eye_mm, cast(float, panel.viewing_distance_mm), cast(float, panel.pixel_pitch_mm) / 3
    gap = line_number * sub_mm / (2 * half_cone_tan) * (-1 if panel.invert_views else 1)
    if z + gap <= 0 or distance + gap <= 0:
        raise InputError(f"eye: z must be larger than the lens gap of {abs(float(gap)):.4g} mm, got {z}")
    lens_mm = line_number * sub_mm * distance / (distance + gap)
    # a is linear in D, with xi = (D - D_mid) p_sub; D_mid is D of a sub-pixel centred on the panel.
    pixel = 0 if panel.subpixel_cells else 1  # D of a pixel's centre, from its reference
    middle = 1.5 * (panel.width_px - 1) + pixel + 1.5 * (panel.height_px - 1) * slant_tan + phase
    shift = middle / line_number + (x - y * slant_tan) * gap / ((z + gap) * lens_mm)
    return EyePath(shift, sub_mm * z / ((z + gap) * lens_mm), middle)


def _turns_along(panel: Panel, channel: int, path: EyePath) -> np.ndarray:
    """Return the lens coordinate of each sub-pixel of a channel, without its row's part: float32 [PERIOD, W], 0..1."""
    columns = np.arange(panel.width_px)
    within = subpixel_offsets(panel)[..., channel].astype(np.float64)[:, columns % PERIOD]
    return _fractions(path.slope * (3 * columns + within + panel.phase - path.middle) + path.shift)


def _fractions(numbers: np.ndarray) -> np.ndarray:
    """Return fractional parts as float32: small numbers, for which that is precise enough."""
    return (numbers - np.floor(numbers)).astype(np.float32)


def _light(turns: np.ndarray, sigma: float) -> np.ndarray:
    """Return the brightness of sub-pixels at these points of their lenses, in lens widths; overwrite `turns`."""
    turns -= np.floor(turns)
    turns -= np.float32(0.5)
    turns *= np.float32(1 / (sigma * math.sqrt(2)))
    np.square(turns, out=turns)
    np.negative(turns, out=turns)
    np.exp(turns, out=turns)
    turns += np.float32(1e-20)  # a cell keeps a colour even if all its sub-pixels are dark
    return turns


def _measured_light(turns: np.ndarray, psf: Psf, lens: float) -> np.ndarray:
    """Return the same by a measured spread of light; lens: its width in sub-pixels."""
    light = psf.seen((turns - np.floor(turns) - 0.5) * lens, lens)
    light += np.float32(1e-20)
    return light


def simulate_eyes(
    image: np.ndarray,
    panel: Panel,
    eyes_mm: Sequence[Sequence[float]] | np.ndarray,
    spread_subpixels: float = 1.0,
    threads: int | None = None,
    psf: Psf | None = None,
) -> np.ndarray:
    """Return the pictures of K eyes: float32 [K, h, w, 3].

    Args:
        image: See simulate.
        panel: See simulate.
        eyes_mm: [K, 3], see simulate.
        spread_subpixels: See simulate.
        threads: See simulate.
        psf: See simulate.

    Raises:
        InputError: As simulate.
    """
    return np.stack([simulate(image, panel, eye, spread_subpixels, threads, psf) for eye in eyes_mm])


def eye_row(panel: Panel, from_mm: float, to_mm: float, count: int) -> np.ndarray:
    """Return eyes [count, 3] in mm, side by side at the viewing distance and the height of the panel's middle.

    Args:
        panel: The panel.
        from_mm: Position of the first eye, to the right of the middle.
        to_mm: Position of the last eye.
        count: Number of eyes.

    Raises:
        InputError: An argument is invalid, or the panel has no viewing distance.
    """
    count = whole_number("eyes: how many", count, 1, _MOST_EYES)
    ends = (real_number("eyes: from, to (mm)", value, -1e7, 1e7) for value in (from_mm, to_mm))
    if panel.viewing_distance_mm is None:
        raise InputError(f"panel {panel.name} lacks viewing_distance_mm; eyes cannot be placed without")
    eyes = np.zeros((count, 3))
    first, last = ends
    eyes[:, 0], eyes[:, 2] = np.linspace(first, last, count), panel.viewing_distance_mm
    return eyes


def zone_width_mm(panel: Panel) -> float:
    """Return the width of the viewing zone at the viewing distance, in mm: an eye in it sees each view once.

    Raises:
        InputError: The panel has no viewing distance.
    """
    if panel.viewing_distance_mm is None:
        raise InputError(f"panel {panel.name} lacks viewing_distance_mm; eyes cannot be placed without")
    return 2 * panel.viewing_distance_mm * math.tan(math.radians(panel.cone_deg) / 2)


def cell_borders(size_px: int, lens_subpixels: float) -> np.ndarray:
    """Return the borders in pixels of cells about one lens wide."""
    count = min(size_px, max(1, round(3 * size_px / lens_subpixels)))
    return np.linspace(0, size_px, count + 1).round().astype(np.int64)


def _sums(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the sums over cells of `values`, whose first row is rows[0]."""
    borders = rows - rows[0]
    joined = np.stack([values[a:b].sum(0) for a, b in zip(borders, borders[1:])])  # four times as fast as reduceat
    return np.add.reduceat(joined, columns[:-1], 1)


def _blurred(cells: np.ndarray, rows: slice) -> np.ndarray:
    """Return these rows of cells, each joined with its neighbours by the weights 1 2 1 both ways.

    Light and its weight are joined alike, so that the sub-pixels that the eye sees best decide.
    """
    first, last = max(0, rows.start - 1), rows.stop + 1
    around = cells[first:last]
    missing = (first - (rows.start - 1), max(0, last - len(cells)))  # rows beyond the edges are dark
    padded = np.pad(around, (missing, (1, 1), (0, 0)))
    across = padded[:, :-2] + 2 * padded[:, 1:-1] + padded[:, 2:]
    return across[:-2] + 2 * across[1:-1] + across[2:]


def checked_eye(eye_mm: Sequence[float]) -> tuple[float, float, float]:
    """Return the three numbers of an eye; raise InputError for any other."""
    if not is_row(eye_mm, 3):
        raise InputError(f"eye: expected three numbers x, y, z in mm, got {shown(eye_mm)}")
    x, y, z = (real_number(f"eye: {axis}", value, -1e7, 1e7) for axis, value in zip("xyz", eye_mm))
    if z <= 0:
        raise InputError(f"eye: z is the distance before the panel in mm and must be above 0, got {z}")
    return x, y, z


def missing_geometry(panel: Panel) -> list[str]:
    """Return the names of the fields that a panel lacks to place an eye before it."""
    return [key for key in ("viewing_distance_mm", "pixel_pitch_mm") if getattr(panel, key) is None]


def check_geometry(panel: Panel) -> None:
    """Raise InputError for a panel before which an eye cannot be placed."""
    expect("panel", panel, Panel)
    if missing := missing_geometry(panel):
        raise InputError(f"panel {panel.name} lacks {' and '.join(missing)}; an eye cannot be placed without")


def _check(image: np.ndarray, panel: Panel) -> None:
    expect("image", image, np.ndarray)
    check_geometry(panel)
    if image.ndim != 3 or image.shape[2] not in (3, 4):
        raise InputError(f"image: expected [H, W, 3], got {list(image.shape)}")
    if image.dtype.name not in ("uint8", "uint16", "float32", "float64"):
        raise InputError(f"image: expected uint8, uint16, float32 or float64, got {image.dtype}")
    if image.shape[:2] != (panel.height_px, panel.width_px):
        raise InputError(
            f"image is {image.shape[1]} x {image.shape[0]} pixels, panel {panel.name} is "
            f"{panel.width_px} x {panel.height_px}; name the panel it was encoded for"
        )
