"""The lens of a panel, estimated from photographs of bars on it, taken from known viewpoints.

The bars are drawn for a profile `start`: a sub-pixel that shows view x of it has the phase x/N. An eye at (x_e, y_e, z)
looks at a point s sub-pixels to the right of and r rows below the panel's middle. Through the true lens it sees the
phase (mod 1)
    start's D/P_e - D/P_e + 1/2 - (xi (z - L) + xi_e (L + L_g)) / (E (z + L_g)),   D = D_mid + s + 3 r tan(slant)
with xi = (s + 3 r tan(slant)) p_sub and xi_e = x_e - y_e tan(slant), in mm. The formula is from docs/design.md, "What
an eye sees", for the sub-pixel in the middle of the light through a lens. So the phase is a plane over the panel. Its
slopes give 1/line_number and slant_tan/line_number, its height the phase, by least squares over all viewpoints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.calibration_photos import CONSTANTS, Fringes, Viewpoint, measure_fringes
from lightfield_gs.panels.lens_change import phase_in_middle, replace_lens
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import missing_geometry


@dataclass(frozen=True)
class CalibrationFitConstants:
    """Thresholds of the fit.

    All are chosen by hand and not tuned on photographs; tests/panels/test_calibration_fit.py has simulated photographs
    that they must accept or refuse.
    """

    least_apart: float = 0.05  # fraction of the viewing zone between the viewpoints that are farthest apart, at least
    # coherence of the photographs with the plane, at least: 1 on the plane, 0 for anything
    least_coherence: float = 0.7
    most_disagreement: float = 0.05  # lens widths between a viewpoint and the plane of all, at most
    rounds: int = 12  # Gauss-Newton steps
    much_worse: float = 1.5  # ratio of misfits from which on the photographs count as turned or mirrored
    surely_worse: float = 10.0  # the same ratio where turned photographs do not fit well either
    least_misfit: float = 1e-5  # misfit below which no difference counts
    good_spread: float = 0.2 / 48  # spread of photographs that fit, at most, in lens widths
    # ratio of width by height, against the expected one, from which on the panel may be turned
    turned_ratio: float = 1.15
    other_shape_ratio: float = 1.3  # the same ratio from which on it is another shape


_CONSTANTS = CalibrationFitConstants()

# Changes of photographs, and the slices of cells [rows, columns] that undo them
_TURNS: dict[str, tuple[slice, slice]] = {
    "mirrored": np.s_[:, ::-1],
    "turned by 180 degrees": np.s_[::-1, ::-1],
    "mirrored top to bottom": np.s_[::-1, :],
}


@dataclass(frozen=True)
class ViewpointFit:
    """The agreement of one viewpoint with the lens that was found.

    Attributes:
        name: Name of the viewpoint.
        offset_views: Mean of the seen less the expected view.
        spread_views: Standard deviation of the same over the panel, in views.
        corners_px: [4, 2], of the panel in the photographs.
    """

    name: str
    offset_views: float
    spread_views: float
    corners_px: np.ndarray


@dataclass(frozen=True)
class CalibrationFit:
    """The panel with the lens that was found, and the agreement of each viewpoint with it."""

    panel: Panel
    viewpoints: tuple[ViewpointFit, ...]


@dataclass(frozen=True)
class _Lens:
    """per_lens = 1/line_number, lean = slant_tan/line_number, turns: phase in the middle, in lens widths."""

    per_lens: float
    lean: float
    turns: float


def fit_lens(viewpoints: Sequence[Viewpoint], start: Panel, one_viewpoint: bool = False) -> CalibrationFit:
    """Fit the lens of the panel that showed `bars(start, ...)` in these photographs.

    Two viewpoints are needed, a twentieth of the viewing zone apart across the lenses. From a single one, shifts in
    another order and mirrored photographs look like another lens.

    Args:
        viewpoints: Photographs with the positions of their cameras.
        start: The profile that the bars were drawn for; its cone_deg, viewing_distance_mm and pixel_pitch_mm are
            trusted.
        one_viewpoint: Whether one is enough, unchecked.

    Raises:
        InputError: The photographs do not determine the lens, or do not agree.
    """
    expect("start", start, Panel)
    if missing := missing_geometry(start):
        raise InputError(
            f"panel {start.name} lacks {' and '.join(missing)}, without which no eye has a place before it"
        )
    _check_viewpoints(viewpoints, start, one_viewpoint)
    lenses = start.line_number / 3
    size = np.array([start.width_px, start.height_px])
    columns, rows = (int(n) for n in np.ceil(size / max(lenses, size.max() / CONSTANTS.most_cells)))
    measured = [measure_fringes(viewpoint, columns, rows) for viewpoint in viewpoints]
    for viewpoint, one in zip(viewpoints, measured):
        _check_upright(viewpoint, one.corners_px, start)
    fitted = _solve(viewpoints, measured, start)
    mirrored = _solve(viewpoints, [Fringes(one.wave.conj(), one.corners_px) for one in measured], start)
    if len(viewpoints) > 1 and _misfit(mirrored[1]) < _misfit(fitted[1]):
        raise InputError(
            "the photographs fit only with the shifts in the order 0, 2, 1, or mirrored, or with the places on the "
            "other side; give the shifts as 0, 1, 2, and x of the eye to the right, seen from the viewer"
        )
    lens, residuals = fitted
    _check_turned(viewpoints, measured, start, _misfit(residuals))
    agreed = tuple(
        _compare_with_all(viewpoint, wave, one, start) for viewpoint, wave, one in zip(viewpoints, residuals, measured)
    )
    per_lens, turns = lens.per_lens, phase_in_middle(start)
    turns += (lens.turns - turns + 0.5) % 1 - 0.5  # lenses are all alike
    return CalibrationFit(replace_lens(start, 1 / per_lens, lens.lean / per_lens, turns), agreed)


def _check_viewpoints(viewpoints: Sequence[Viewpoint], start: Panel, one_viewpoint: bool) -> None:
    if not viewpoints:
        raise InputError("no photographs; expected three, of the shifts 0, 1 and 2, from each of two places at least")
    zone = _zone_mm(start)
    across = [(viewpoint.eye_mm[0] - viewpoint.eye_mm[1] * start.slant_tan) / zone for viewpoint in viewpoints]
    apart = max(abs((a - b + 0.5) % 1 - 0.5) for a in across for b in across)
    if apart < _CONSTANTS.least_apart and not one_viewpoint:
        where = "one place" if len(viewpoints) == 1 else "places too close across the lenses"
        raise InputError(
            f"the photographs are from {where}, which cannot tell another lens from shifts in another order or a "
            f"mirrored photograph: add some from {_CONSTANTS.least_apart * abs(zone):.0f} mm aside at least, or "
            "say that one place will do (one_place=True)"
        )


def _check_upright(viewpoint: Viewpoint, corners_px: np.ndarray, start: Panel) -> None:
    """Raise InputError where the panel is turned by 90 degrees in the photographs, or has another shape."""
    across, down = np.hypot(*(np.roll(corners_px, -1, 0) - corners_px).T).reshape(2, 2).mean(0)
    x, y, z = viewpoint.eye_mm
    expected = start.width_px / start.height_px * math.hypot(y, z) / math.hypot(x, z)  # seen from aside, it is narrower
    got = across / down
    turned = abs(math.log(got * expected))
    if abs(math.log(got / expected)) > math.log(_CONSTANTS.turned_ratio) > turned:
        raise InputError(
            f"{viewpoint.name}: expected a panel of {start.width_px} x {start.height_px} pixels, its width about "
            f"{expected:.2f} times its height, got one of {got:.2f} times; the photographs are turned by 90 degrees: "
            "turn them upright, or give the corners as the panel has them"
        )
    if abs(math.log(got / expected)) > math.log(_CONSTANTS.other_shape_ratio):
        raise InputError(
            f"{viewpoint.name}: expected a panel of {start.width_px} x {start.height_px} pixels, its width about "
            f"{expected:.2f} times its height, got one of {got:.2f} times; take it whole, give photographs that are "
            "not squeezed, of the panel of this profile, or the corners as the panel has them"
        )


def _check_turned(viewpoints: Sequence[Viewpoint], measured: Sequence[Fringes], start: Panel, misfit: float) -> None:
    """Raise InputError where photographs fit the bars much better turned by 180 degrees or mirrored."""
    found = {
        words: _misfit(_solve(viewpoints, [Fringes(one.wave[undone], one.corners_px) for one in measured], start)[1])
        for words, undone in _TURNS.items()
    }
    best = min(found, key=found.__getitem__)
    least = max(found[best], _CONSTANTS.least_misfit)
    # With different exposures, or with a blurred photograph, all turns fit badly, and one fits less badly by chance
    good = (2 * math.pi * _CONSTANTS.good_spread) ** 2 / 2
    if misfit > (_CONSTANTS.much_worse if least < good else _CONSTANTS.surely_worse) * least:
        raise InputError(
            f"the photographs fit {misfit / least:.3g} times better if they are {best}: have them as the camera sees "
            "the panel, upright and not mirrored, or give the corners as the panel has them"
        )


def _zone_mm(panel: Panel) -> float:
    """Return E, the width of the viewing zone; below 0 where views run the other way."""
    zone = 2 * cast(float, panel.viewing_distance_mm) * math.tan(math.radians(panel.cone_deg) / 2)
    return -zone if panel.invert_views else zone


def _grid(wave: np.ndarray, panel: Panel) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells' positions from the panel's middle: s [1, columns], sub-pixels right; r [rows, 1], rows down."""
    rows, columns = wave.shape
    s = ((np.arange(columns) + 0.5) / columns - 0.5) * 3 * panel.width_px
    r = ((np.arange(rows) + 0.5) / rows - 0.5) * panel.height_px
    return s[None], r[:, None]


def _expected_phase(viewpoint: Viewpoint, lens: _Lens, start: Panel, s: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Return the phase that the eye should see, by the equation above, [rows, columns]."""
    (x, y, z), zone = viewpoint.eye_mm, _zone_mm(start)
    distance, sub_mm = cast(float, start.viewing_distance_mm), cast(float, start.pixel_pitch_mm) / 3
    slant = lens.lean / lens.per_lens
    gap = sub_mm * distance / (zone * lens.per_lens)
    if min(z, distance) + gap <= 0:
        raise InputError(
            f"{viewpoint.name}: z of the eye must be larger than the lens gap of {abs(gap):.4g} mm, got {z}"
        )
    across_mm = (s + 3 * r * slant) * sub_mm * (z - distance) + (x - y * slant) * (distance + gap)
    start_phase = phase_in_middle(start) + (s + 3 * r * start.slant_tan) / start.line_number
    return start_phase - (lens.turns + lens.per_lens * s + 3 * lens.lean * r) + 0.5 - across_mm / (zone * (z + gap))


def _solve(
    viewpoints: Sequence[Viewpoint], measured: Sequence[Fringes], start: Panel
) -> tuple[_Lens, list[np.ndarray]]:
    """Return the lens that explains the phases best, and the waves e^(2 pi i residual) left over; 0 without bars."""
    s, r = _grid(measured[0].wave, start)
    lens = _Lens(1 / start.line_number, start.slant_tan / start.line_number, phase_in_middle(start))

    def residuals() -> list[np.ndarray]:
        planes = (_expected_phase(viewpoint, lens, start, s, r) for viewpoint in viewpoints)
        return [one.wave * np.exp(-2j * np.pi * plane) for one, plane in zip(measured, planes)]

    across, down = _strongest_wave(residuals())
    lens = _Lens(
        lens.per_lens - across * s.shape[1] / (3 * start.width_px),
        lens.lean - down * r.shape[0] / (3 * start.height_px),
        lens.turns,
    )
    height = np.angle(sum(wave.sum() for wave in residuals())) / (2 * np.pi)
    lens = _Lens(lens.per_lens, lens.lean, lens.turns - height)
    for _ in range(_CONSTANTS.rounds):
        left, normal = np.zeros(3), np.zeros((3, 3))
        for wave in residuals():
            cells = wave != 0
            terms = np.stack([part[cells] for part in np.broadcast_arrays(s, 3 * r, 1.0)])
            normal += terms @ terms.T
            left += terms @ np.angle(wave[cells]) / (2 * np.pi)
        change = np.linalg.solve(normal, left)
        lens = _Lens(lens.per_lens - change[0], lens.lean - change[1], lens.turns - change[2])
        if not 0.5 < lens.per_lens * start.line_number < 2:
            raise InputError("the bars in the photographs run as no lens near that of the profile makes them")
    return lens, residuals()


def _strongest_wave(waves: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the turns per cell, across and down, of the strongest plane wave in all of these."""
    rows, columns = waves[0].shape
    shape = (4 * rows, 4 * columns)
    power = sum(np.abs(np.fft.fft2(wave, shape)) ** 2 for wave in waves)
    down, across = np.unravel_index(int(np.argmax(power)), shape)
    return float(np.fft.fftfreq(shape[1])[across]), float(np.fft.fftfreq(shape[0])[down])


def _misfit(waves: Sequence[np.ndarray]) -> float:
    """Return 0 where all waves are the constant 1, up to 1 where they are anything."""
    return 1 - float(sum(wave.real.sum() for wave in waves) / sum(np.abs(wave).sum() for wave in waves))


def _compare_with_all(viewpoint: Viewpoint, wave: np.ndarray, one: Fringes, start: Panel) -> ViewpointFit:
    """Return the agreement of a viewpoint with the lens of all; raise InputError where there is none."""
    mean = wave[wave != 0].mean()
    if abs(mean) < _CONSTANTS.least_coherence:
        raise InputError(
            f"{viewpoint.name}: what is seen is not the bars of panel {start.name} ({100 * abs(mean):.0f} % agree "
            "with a plane); show `calibrate pattern phase` of this very profile unscaled, and check the corners"
        )
    offset = float(np.angle(mean)) / (2 * np.pi)
    if abs(offset) > _CONSTANTS.most_disagreement:
        raise InputError(
            f"{viewpoint.name}: it sees the panel {offset * start.views:+.3g} views off what the others see; check "
            "its eye (in mm from the panel's middle), and cone_deg and viewing_distance_mm of the profile"
        )
    spread = math.sqrt(max(0.0, -2 * math.log(min(1.0, abs(mean))))) / (2 * np.pi)
    return ViewpointFit(viewpoint.name, offset * start.views, spread * start.views, one.corners_px)
