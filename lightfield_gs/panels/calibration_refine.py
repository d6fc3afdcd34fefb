"""The lens of a panel, refined: the photographs of its bars against what `simulate` says that the cameras saw.

calibration_fit takes the phase of the bars for a plane. But an eye sees whole sub-pixels. Where the lenses stand in a
simple ratio to them, as with a slant of 1/3, the phase moves in steps, and its mean is off. Here the expected light is
that of the pattern through the lens, sub-pixel by sub-pixel. Its derivatives are by torch, and Gauss-Newton steps take
the lens to the least squares of the phases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from lightfield_gs.base.arrays import decode_srgb
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.calibration_fit import CalibrationFit
from lightfield_gs.panels.calibration_photos import Viewpoint, measure_waves, wave_of
from lightfield_gs.panels.lens_change import middle_coordinate, phase_in_middle, replace_lens
from lightfield_gs.panels.optics import Optics
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.patterns import bars
from lightfield_gs.panels.simulate_tensors import cell_count, simulate_rows

_CHUNK_SUBPIXELS = 6_000_000  # that are simulated at a time, for the sake of memory


@dataclass(frozen=True)
class CalibrationRefineConstants:
    """Limits of the refinement, chosen by hand and not tuned on photographs."""

    rounds: int = 12  # Gauss-Newton steps, at most
    least_step: float = 1e-5  # largest change of phase on the panel, in lens widths, below which they end
    blurs: int = 2  # of both waves over their neighbours, so that the sharpness of the camera matters less
    margin: int = 3  # cells at the edges of the panel that are left out, where blurs take in the dark around


_CONSTANTS = CalibrationRefineConstants()


@dataclass(frozen=True)
class RefinedFit:
    """A lens by refine_lens.

    Attributes:
        panel: The panel with the lens.
        before: Root mean square of the phases left over before the first step, in views.
        after: The same for the lens found.
    """

    panel: Panel
    before: float
    after: float


def refine_lens(viewpoints: Sequence[Viewpoint], start: Panel, fit: CalibrationFit) -> RefinedFit:
    """Refine the lens that fit_lens found in the same photographs. It takes about a minute for a million pixels.

    Args:
        viewpoints: See fit_lens.
        start: See fit_lens.
        fit: Its result. A step that would make the photographs agree less is not taken.

    Raises:
        InputError: The photographs do not determine the lens.
    """
    shown = _shown(viewpoints, start)
    rows, columns = cell_count(start)
    waves = [_blurred(measure_waves(viewpoint, columns, rows)[0]) for viewpoint in viewpoints]
    lens = fit.panel
    numbers = np.array([1 / lens.line_number, lens.slant_tan / lens.line_number, phase_in_middle(lens)])
    # Each number in units that move the phase at the edge by one lens width
    units = np.array([2 / (3 * start.width_px), 2 / (3 * start.height_px), 1.0])
    best: np.ndarray = np.zeros(3)
    step, change = best, best
    first, least = None, np.inf
    for _ in range(_CONSTANTS.rounds):
        normal, left, misfit = np.zeros((3, 3)), np.zeros(3), 0.0
        for viewpoint, wave, pattern in zip(viewpoints, waves, shown):
            expected, slopes = _expected(viewpoint, pattern, start, numbers + units * step, units)
            terms, phases = _phases(wave, expected, slopes)
            normal, left = normal + terms @ terms.T, left + terms @ phases
            misfit += float((phases**2).mean()) / len(viewpoints)
        first = misfit if first is None else first
        if misfit < least:
            best, least = step, misfit
            try:
                change = np.linalg.solve(normal, left)
            except np.linalg.LinAlgError:
                raise InputError("the photographs do not determine the lens: add some from other places") from None
        else:
            change = change / 4  # too long a step
        step = best + change
        if np.abs(change).sum() < _CONSTANTS.least_step:
            break
    assert first is not None
    per_lens, lean, turns = (numbers + units * best).tolist()
    views = start.views / (2 * np.pi)
    return RefinedFit(replace_lens(start, 1 / per_lens, lean / per_lens, turns), views * first**0.5, views * least**0.5)


def _shown(viewpoints: Sequence[Viewpoint], start: Panel) -> list[Tensor]:
    """Return the light of the pattern before each viewpoint, [1 or 3, H, W, 3] float32."""
    patterns: dict[int, Tensor] = {}
    for count in {len(viewpoint.photos) for viewpoint in viewpoints}:
        codes = [bars(start)] if count == 1 else [bars(start, shift) for shift in range(3)]
        patterns[count] = torch.from_numpy(np.stack([decode_srgb(code / np.float32(255)) for code in codes])).float()
    return [patterns[len(viewpoint.photos)] for viewpoint in viewpoints]


def _expected(
    viewpoint: Viewpoint, pattern: Tensor, start: Panel, numbers: np.ndarray, units: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the waves that a viewpoint should see, complex [h, w], and their derivatives by each number, [3, h, w]."""
    (height, _), point, scales = cell_count(start), torch.from_numpy(numbers), torch.from_numpy(units)
    middles = [middle_coordinate(replace(start, slant_tan=slant)) for slant in (0.0, 1.0)]
    chunk = max(1, round(_CHUNK_SUBPIXELS / (3 * start.width_px * start.height_px) * height))
    parts = []
    for first in range(0, height, chunk):
        rows = slice(first, min(first + chunk, height))

        def light(numbers: Tensor, rows: slice = rows) -> Tensor:
            per_lens, lean, turns = numbers.unbind()
            slant = lean / per_lens
            phase = turns / per_lens - (middles[0] + (middles[1] - middles[0]) * slant)
            optics = Optics(line_number=1 / per_lens, slant_tan=slant, phase=phase)
            seen = simulate_rows(pattern, start, viewpoint.eye_mm, rows, optics)
            return seen[0] if len(seen) == 1 else seen.mean(-1).movedim(0, -1)

        found = []
        for direction in torch.diag(scales):
            with forward_ad.dual_level():
                found.append(forward_ad.unpack_dual(light(forward_ad.make_dual(point, direction))))
        parts.append(torch.stack([found[0].primal, *(one.tangent for one in found)]))
    waves = wave_of(torch.cat(parts, 1).double().numpy())
    return waves[0], waves[1:]


def _phases(wave: np.ndarray, expected: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what is left of the phases in the cells that show bars, [n], and its terms [3, n] of least squares.

    Both are weighted by the amplitude that the bars should have, for noise moves the phase of faint ones more.
    """
    blurred, inner = _blurred(expected), np.s_[_CONSTANTS.margin : -_CONSTANTS.margin]
    seen = (wave[inner, inner] != 0) & (blurred[inner, inner] != 0)
    at = blurred[inner, inner][seen]
    weight = np.abs(at) / np.sqrt((np.abs(at) ** 2).mean())
    terms = np.stack([(_blurred(slope)[inner, inner][seen] * at.conj()).imag for slope in slopes]) / np.abs(at) ** 2
    return weight * terms, weight * np.angle(wave[inner, inner][seen] * at.conj())


def _blurred(wave: np.ndarray) -> np.ndarray:
    """Return waves [h, w] blurred by 1 2 1 both ways, `blurs` times; 0 where a neighbour has none."""
    from scipy.ndimage import convolve1d, minimum_filter

    seen = minimum_filter((wave != 0).astype(np.uint8), 2 * _CONSTANTS.blurs + 1, mode="constant")
    for axis in (0, 1) * _CONSTANTS.blurs:
        wave = convolve1d(wave, [0.25, 0.5, 0.25], axis, mode="constant")
    return np.where(seen, wave, 0)
