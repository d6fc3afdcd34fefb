"""The lens found from photographs, with `simulate` as the camera."""

import math
from dataclasses import replace

import numpy as np
import pytest
from panel_cases import template_panel

from benchmarks.calibration import CORNERS, EYES, errors, photograph, rows
from lightfield_gs.base.arrays import decode_srgb
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.calibrate_fit import implausible_places
from lightfield_gs.panels.calibration_fit import fit_lens
from lightfield_gs.panels.calibration_photos import Viewpoint, find_corners
from lightfield_gs.panels.calibration_refine import refine_lens
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.patterns import bars

START = template_panel(960, 540, 48, phase=-310.4, viewing_distance_mm=600, pixel_pitch_mm=0.2)


def perturbed(panel: Panel) -> Panel:
    """Pitch 0.1 % more, slope 0.5 % more, centre 0.2 lens widths more, by the formulas of DESIGN 3."""
    dpi = 25.4 / panel.pixel_pitch_mm
    slope = -1 / panel.slant_tan
    pitch = 3 * dpi / (panel.line_number * math.cos(math.atan(1 / slope)))
    centre = (1.5 + 3 * (panel.height_px - 0.5) / slope - panel.phase) / panel.line_number
    pitch, slope, centre = pitch * 1.001, slope * 1.005, centre + 0.2
    lens = 3 * dpi / (pitch * math.cos(math.atan(1 / slope)))
    phase = 1.5 + 3 * (panel.height_px - 0.5) / slope - centre * lens
    return replace(panel, line_number=lens, slant_tan=-1 / slope, phase=phase)


def places(true, eyes=EYES, start=START, corners=CORNERS, shifts=(0, 1, 2), **options) -> list[Viewpoint]:
    shown = [bars(start, shift) for shift in shifts]
    return [
        Viewpoint(
            eye, tuple(photograph(one, true, eye, seed=k, **options) for k, one in enumerate(shown)), corners, f"{eye}"
        )
        for eye in eyes
    ]


def worst_views(a: Panel, b: Panel) -> float:
    """The largest difference of their views over the panel: of a plane, in a corner."""
    return errors(a, b)["worst_views"]


@pytest.mark.parametrize("corners", [CORNERS, None], ids=["given", "found"])
@pytest.mark.parametrize("change", [{}, dict(invert_views=True, slant_tan=-0.2)], ids=["plain", "inverted"])
def test_the_lens_is_found_to_a_fraction_of_a_view(change, corners):
    start = replace(START, **change)
    true = perturbed(start)
    assert worst_views(start, true) > 8
    fit = fit_lens(places(true, start=start, corners=corners), start)
    assert worst_views(fit.panel, true) < 0.02
    assert fit.panel.line_number == pytest.approx(true.line_number, rel=1e-5)
    assert fit.panel.slant_tan == pytest.approx(true.slant_tan, rel=1e-4)
    assert all(abs(place.offset_views) < 0.02 for place in fit.viewpoints)


def test_one_image_in_three_colours_will_do():
    true = perturbed(START)
    sights = [Viewpoint(eye, (photograph(bars(START), true, eye),), CORNERS) for eye in EYES]
    assert worst_views(fit_lens(sights, START).panel, true) < 0.02


def test_corners_are_found_to_a_fraction_of_a_pixel():
    light = decode_srgb(np.mean(places(START, EYES[:1])[0].photos, 0) / 255).mean(2)
    assert np.abs(find_corners(light) - CORNERS).max() < 0.5


def test_what_says_nothing_is_refused():
    true = perturbed(START)
    good = places(true)
    with pytest.raises(InputError, match="one place"):
        fit_lens(good[:1], START)
    assert worst_views(fit_lens(good[:1], START, one_viewpoint=True).panel, true) < 0.02
    with pytest.raises(InputError, match="three photographs.*got 2"):
        Viewpoint(EYES[0], good[0].photos[:2])
    with pytest.raises(InputError, match="can be seen on"):
        fit_lens([replace(place, photos=place.photos[:1] * 3) for place in good], START)
    with pytest.raises(InputError, match="order 0, 2, 1"):
        fit_lens([replace(place, photos=tuple(place.photos[k] for k in (0, 2, 1))) for place in good], START)
    with pytest.raises(InputError, match="check its eye"):
        fit_lens([good[0], replace(good[1], eye_mm=(130.0, 20.0, 560.0))], START)
    with pytest.raises(InputError, match="upper left"):
        fit_lens([replace(place, corners_px=CORNERS[::-1]) for place in good], START)
    with pytest.raises(InputError, match="pixel_pitch_mm"):
        fit_lens(good, replace(START, pixel_pitch_mm=None))


def test_photographs_that_are_turned_or_mirrored_are_refused():
    true, upright = perturbed(START), np.array([[90.0, 60.0], [690.0, 60.0], [690.0, 398.0], [90.0, 398.0]])
    good = places(true, corners=upright)
    found = [replace(place, corners_px=None) for place in good]
    assert worst_views(fit_lens(found, START).panel, true) < 0.02
    for words, taken in (
        ("are mirrored", lambda photo: photo[:, ::-1]),
        ("are turned by 180 degrees", lambda photo: photo[::-1, ::-1]),
        ("are turned by 90 degrees", lambda photo: np.rot90(photo)),
    ):
        turned = [replace(place, photos=tuple(taken(photo).copy() for photo in place.photos)) for place in found]
        with pytest.raises(InputError, match=words):
            fit_lens(turned, START)


def test_photographs_of_unlike_exposure_are_doubted():
    good = places(perturbed(START))
    dark = [
        replace(place, photos=(place.photos[0], (place.photos[1] * 0.8).astype(np.uint8), place.photos[2]))
        for place in good
    ]
    assert implausible_places(fit_lens(good, START)) == []
    said = implausible_places(fit_lens(dark, START))
    assert len(said) == 2 and "check that all have one exposure" in said[0]


def test_panels_that_are_cut_off_or_squeezed_are_refused_and_places_that_lie_off_doubted():
    true, upright = perturbed(START), np.array([[90.0, 60.0], [690.0, 60.0], [690.0, 398.0], [90.0, 398.0]])
    good = [replace(place, corners_px=None) for place in places(true, corners=upright)]
    for words, taken in (
        ("cut off at their rim", lambda photo: photo[:, :600]),
        ("its width about 1.* got one of", lambda photo: photo[:, ::2]),
    ):
        with pytest.raises(InputError, match=words):
            fit_lens([replace(place, photos=tuple(taken(one).copy() for one in place.photos)) for place in good], START)
    said = implausible_places(fit_lens([good[0], replace(good[1], eye_mm=(76.0, 20.0, 560.0))], START))
    assert len(said) == 2 and "check its eye" in said[0]


SMALL = replace(START, width_px=320, height_px=180, pixel_pitch_mm=0.6)


def test_a_lens_is_refined_to_a_tenth_of_the_error_where_the_bars_move_in_steps():
    """Lenses of nine sub-pixels that lean by one a row: the bars are no plane."""
    (row,) = rows(lenses=[(9.0, 1 / 3)], base=SMALL)
    for name in ("phase_views", "worst_views"):
        assert row["before"][name] > 0.01 and row["after"][name] < 0.1 * row["before"][name]


def test_refining_takes_one_image_in_three_colours_too():
    small = replace(SMALL, line_number=9.0, slant_tan=1 / 3)
    true = perturbed(small)
    sights = [Viewpoint(eye, (photograph(bars(small), true, eye),), CORNERS) for eye in EYES]
    fit = fit_lens(sights, small)
    refined = refine_lens(sights, small, fit)
    assert worst_views(refined.panel, true) < 0.5 * worst_views(fit.panel, true)
    assert refined.after < refined.before
