"""The lens of a panel, estimated from photographs of bars that it shows, taken from known places.

The bars are drawn for a profile `start`: what shows view x of it has the phase x/N. Through the true lens an eye at
(x_e, y_e, z) sees at a place of the panel, s sub-pixels to the right and r rows below its middle, the phase (mod 1)
    start's D/P_e - D/P_e + 1/2 - (xi (z - L) + xi_e (L + L_g)) / (E (z + L_g)),   D = D_mid + s + 3 r tan(slant)
with xi = (s + 3 r tan(slant)) p_sub and xi_e = x_e - y_e tan(slant), in mm: from docs/design.md, "What an eye sees",
for the sub-pixel in the middle of what the lens lights. So the phase is a plane over the panel. Its slopes give
1/line_number and slant_tan/line_number, its height the phase, by least squares over all places.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.calibration_photos import MOST_CELLS, Fringes, Viewpoint, measure_fringes
from lightfield_gs.panels.lens_change import phase_in_middle, replace_lens
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import missing_geometry

_LEAST_APART = 0.05  # of the viewing zone, between the places that are farthest apart
_LEAST_COHERENCE = 0.7  # of what is seen with the plane: 1 where it is one, 0 where it is anything
_MOST_DISAGREEMENT = 0.05  # of a place with the plane of all, in lens widths
_ROUNDS = 12
_MUCH_WORSE = 1.5  # times the misfit of turned or mirrored photographs, from which on these are what was taken
_LEAST_MISFIT = 1e-5  # below which no difference counts
# Of width by height, against what the eye should see: as turned panels have it, and from which on it is another shape
_LEAST_TURNED, _OTHER_SHAPE = 1.15, 1.3
_SURELY_WORSE = 10.0  # times the misfit, from which on turned photographs need not fit well to be believed
_TURNS: dict[
    str, tuple[slice, slice]
] = {  # what was done to the photographs, and what undoes it on the cells [rows, columns] of the panel
    "mirrored": np.s_[:, ::-1],
    "turned by 180 degrees": np.s_[::-1, ::-1],
    "mirrored top to bottom": np.s_[::-1, :],
}


@dataclass(frozen=True)
class ViewpointFit:
    """How one place agrees with the lens that was found, in views: offset, the mean of what is seen less what was to be
    seen; spread, the standard deviation of the same over the panel. corners_px [4, 2]: of the panel in its photographs.
    """

    name: str
    offset_views: float
    spread_views: float
    corners_px: np.ndarray


@dataclass(frozen=True)
class CalibrationFit:
    """The panel with the lens that was found, and how each place agrees with it."""

    panel: Panel
    places: tuple[ViewpointFit, ...]


def most_spread_views(panel: Panel) -> float:
    """Views, or in lens widths the same of 48, above which the spread of photographs is doubtful."""
    return max(0.2, 0.2 / 48 * panel.views)


@dataclass(frozen=True)
class _Lens:
    """per_lens = 1/line_number, lean = slant_tan/line_number, turns: phase in the middle, in lens widths."""

    per_lens: float
    lean: float
    turns: float


def fit_lens(places: Sequence[Viewpoint], start: Panel, one_place: bool = False) -> CalibrationFit:
    """The lens of the panel that showed `bars(start, ...)` in these photographs.

    start: the profile that the pattern was drawn for; its cone_deg, viewing_distance_mm and pixel_pitch_mm are trusted.
    Needed are two places at least, a twentieth of the viewing zone apart (across the lenses): from one alone, shifts in
    another order and mirrored photographs cannot be told from another lens. one_place: one will do, on your word.
    Raises InputError where the photographs do not say what the lens is, or do not agree.
    """
    expect("start", start, Panel)
    if missing := missing_geometry(start):
        raise InputError(
            f"panel {start.name} lacks {' and '.join(missing)}, without which no eye has a place before it"
        )
    _check_places(places, start, one_place)
    lenses = start.line_number / 3
    size = np.array([start.width_px, start.height_px])
    columns, rows = (int(n) for n in np.ceil(size / max(lenses, size.max() / MOST_CELLS)))
    seen = [measure_fringes(place, columns, rows) for place in places]
    for place, one in zip(places, seen):
        _check_upright(place, one.corners_px, start)
    fitted = _solved(places, seen, start)
    mirrored = _solved(places, [Fringes(one.wave.conj(), one.corners_px) for one in seen], start)
    if len(places) > 1 and _misfit(mirrored[1]) < _misfit(fitted[1]):
        raise InputError(
            "the photographs fit only with the shifts in the order 0, 2, 1, or mirrored, or with the places on the "
            "other side; give the shifts as 0, 1, 2, and x of the eye to the right, seen from the viewer"
        )
    lens, residuals = fitted
    _check_turned(places, seen, start, _misfit(residuals))
    agreed = tuple(_agreement(place, wave, one, start) for place, wave, one in zip(places, residuals, seen))
    per_lens, turns = lens.per_lens, phase_in_middle(start)
    turns += (lens.turns - turns + 0.5) % 1 - 0.5  # lenses are all alike
    return CalibrationFit(replace_lens(start, 1 / per_lens, lens.lean / per_lens, turns), agreed)


def _check_places(places: Sequence[Viewpoint], start: Panel, one_place: bool) -> None:
    if not places:
        raise InputError("no photographs; expected three, of the shifts 0, 1 and 2, from each of two places at least")
    zone = _zone_mm(start)
    across = [(place.eye_mm[0] - place.eye_mm[1] * start.slant_tan) / zone for place in places]
    apart = max(abs((a - b + 0.5) % 1 - 0.5) for a in across for b in across)
    if apart < _LEAST_APART and not one_place:
        where = "one place" if len(places) == 1 else "places too close across the lenses"
        raise InputError(
            f"the photographs are from {where}, which cannot tell another lens from shifts in another order or a "
            f"mirrored photograph: add some from {_LEAST_APART * abs(zone):.0f} mm aside at least, or say that one "
            "place will do (--one-place)"
        )


def _check_upright(place: Viewpoint, corners_px: np.ndarray, start: Panel) -> None:
    """Raises InputError where the panel stands upright in the photographs though it is wide, or the other way, and
    where it has another shape."""
    across, down = np.hypot(*(np.roll(corners_px, -1, 0) - corners_px).T).reshape(2, 2).mean(0)
    x, y, z = place.eye_mm
    expected = start.width_px / start.height_px * math.hypot(y, z) / math.hypot(x, z)  # seen from aside, it is narrower
    got = across / down
    turned = abs(math.log(got * expected))
    if abs(math.log(got / expected)) > math.log(_LEAST_TURNED) > turned:
        raise InputError(
            f"{place.name}: expected a panel of {start.width_px} x {start.height_px} pixels, its width about "
            f"{expected:.2f} times its height, got one of {got:.2f} times; the photographs are turned by 90 degrees: "
            "turn them upright, or give the corners as the panel has them"
        )
    if abs(math.log(got / expected)) > math.log(_OTHER_SHAPE):
        raise InputError(
            f"{place.name}: expected a panel of {start.width_px} x {start.height_px} pixels, its width about "
            f"{expected:.2f} times its height, got one of {got:.2f} times; take it whole, give photographs that are "
            "not squeezed, of the panel of this profile, or the corners as the panel has them"
        )


def _check_turned(places: Sequence[Viewpoint], seen: Sequence[Fringes], start: Panel, misfit: float) -> None:
    """Raises InputError where photographs that are turned by 180 degrees or mirrored fit the bars much better."""
    found = {
        words: _misfit(_solved(places, [Fringes(one.wave[undone], one.corners_px) for one in seen], start)[1])
        for words, undone in _TURNS.items()
    }
    best = min(found, key=found.__getitem__)
    least = max(found[best], _LEAST_MISFIT)
    # Where photographs are of unlike exposure, or one is blurred, all fit badly, and some turn by chance less
    good = (2 * math.pi * most_spread_views(start) / start.views) ** 2 / 2
    if misfit > (_MUCH_WORSE if least < good else _SURELY_WORSE) * least:
        raise InputError(
            f"the photographs fit {misfit / least:.3g} times better if they are {best}: have them as the camera sees "
            "the panel, upright and not mirrored, or give the corners as the panel has them"
        )


def _zone_mm(panel: Panel) -> float:
    """E, the width of the viewing zone; below 0 where views run the other way."""
    zone = 2 * cast(float, panel.viewing_distance_mm) * math.tan(math.radians(panel.cone_deg) / 2)
    return -zone if panel.invert_views else zone


def _grid(wave: np.ndarray, panel: Panel) -> tuple[np.ndarray, np.ndarray]:
    """s, sub-pixels to the right of the panel's middle, and r, rows below it, of the cells: [1, columns], [rows, 1]."""
    rows, columns = wave.shape
    s = ((np.arange(columns) + 0.5) / columns - 0.5) * 3 * panel.width_px
    r = ((np.arange(rows) + 0.5) / rows - 0.5) * panel.height_px
    return s[None], r[:, None]


def _expected(place: Viewpoint, lens: _Lens, start: Panel, s: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The phase that the eye should see, by the equation above, [rows, columns]."""
    (x, y, z), zone = place.eye_mm, _zone_mm(start)
    distance, sub_mm = cast(float, start.viewing_distance_mm), cast(float, start.pixel_pitch_mm) / 3
    slant = lens.lean / lens.per_lens
    gap = sub_mm * distance / (zone * lens.per_lens)
    if min(z, distance) + gap <= 0:
        raise InputError(f"{place.name}: z of the eye must be larger than the lens gap of {abs(gap):.4g} mm, got {z}")
    across_mm = (s + 3 * r * slant) * sub_mm * (z - distance) + (x - y * slant) * (distance + gap)
    drawn = phase_in_middle(start) + (s + 3 * r * start.slant_tan) / start.line_number
    return drawn - (lens.turns + lens.per_lens * s + 3 * lens.lean * r) + 0.5 - across_mm / (zone * (z + gap))


def _solved(places: Sequence[Viewpoint], seen: Sequence[Fringes], start: Panel) -> tuple[_Lens, list[np.ndarray]]:
    """The lens that explains the phases best, and the waves e^(2 pi i residual) that it leaves; 0 where none is."""
    s, r = _grid(seen[0].wave, start)
    lens = _Lens(1 / start.line_number, start.slant_tan / start.line_number, phase_in_middle(start))

    def residuals() -> list[np.ndarray]:
        planes = (_expected(place, lens, start, s, r) for place in places)
        return [one.wave * np.exp(-2j * np.pi * plane) for one, plane in zip(seen, planes)]

    across, down = _steepest(residuals())
    lens = _Lens(
        lens.per_lens - across * s.shape[1] / (3 * start.width_px),
        lens.lean - down * r.shape[0] / (3 * start.height_px),
        lens.turns,
    )
    height = np.angle(sum(wave.sum() for wave in residuals())) / (2 * np.pi)
    lens = _Lens(lens.per_lens, lens.lean, lens.turns - height)
    for _ in range(_ROUNDS):
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


def _steepest(waves: Sequence[np.ndarray]) -> tuple[float, float]:
    """Turns per cell, across and down, of the plane wave that all of these have most of."""
    rows, columns = waves[0].shape
    shape = (4 * rows, 4 * columns)
    power = sum(np.abs(np.fft.fft2(wave, shape)) ** 2 for wave in waves)
    down, across = np.unravel_index(int(np.argmax(power)), shape)
    return float(np.fft.fftfreq(shape[1])[across]), float(np.fft.fftfreq(shape[0])[down])


def _misfit(waves: Sequence[np.ndarray]) -> float:
    """1 less how much all waves are the constant 1, 0 for a perfect fit."""
    return 1 - float(sum(wave.real.sum() for wave in waves) / sum(np.abs(wave).sum() for wave in waves))


def _agreement(place: Viewpoint, wave: np.ndarray, one: Fringes, start: Panel) -> ViewpointFit:
    """How a place agrees with the lens of all. Raises InputError where it does not."""
    mean = wave[wave != 0].mean()
    if abs(mean) < _LEAST_COHERENCE:
        raise InputError(
            f"{place.name}: what is seen is not the bars of panel {start.name} ({100 * abs(mean):.0f} % agree with a "
            "plane); show `calibrate pattern phase` of this very profile unscaled, and check the corners"
        )
    offset = float(np.angle(mean)) / (2 * np.pi)
    if abs(offset) > _MOST_DISAGREEMENT:
        raise InputError(
            f"{place.name}: it sees the panel {offset * start.views:+.3g} views off what the others see; check its eye "
            "(in mm from the panel's middle), and cone_deg and viewing_distance_mm of the profile"
        )
    spread = math.sqrt(max(0.0, -2 * math.log(min(1.0, abs(mean))))) / (2 * np.pi)
    return ViewpointFit(place.name, offset * start.views, spread * start.views, one.corners_px)
