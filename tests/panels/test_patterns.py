"""Calibration patterns, as eyes before the panel see them."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.text_files import config_names
from lightfield_gs.panels.lens_change import LensChange, changed
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.patterns import (
    _format_signed,
    bars,
    depth_ramp,
    displayed_numbers,
    fan,
    lens_phases,
    number_picture,
    numbers,
    single,
    sweep,
    text_dots,
)
from lightfield_gs.panels.simulate import simulate

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases" / "panels"
PANELS = [*config_names("panels"), *sorted(CASES.glob("*.*"))]  # of the latter none where the folder is absent
TOY = Panel.load("toy-8v")


def at_hand(source) -> Panel:
    """The panel with measures where its profile has none, and of a large one the middle."""
    panel = Panel.load(source)
    panel = replace(
        panel, viewing_distance_mm=panel.viewing_distance_mm or 600.0, pixel_pitch_mm=panel.pixel_pitch_mm or 0.2
    )
    return replace(panel, width_px=min(panel.width_px, 960), height_px=min(panel.height_px, 480))


def eye_of(panel: Panel, view: float, y_mm: float = 0.0) -> tuple[float, float, float]:
    """Return an eye at the viewing distance that sees the middle of that view, from DESIGN 3: x = N (1/2 - xi/E)."""
    zone_mm = 2 * panel.viewing_distance_mm * math.tan(math.radians(panel.cone_deg) / 2)
    xi = (0.5 - (view + 0.5) / panel.views) * zone_mm * (-1 if panel.invert_views else 1)
    return xi + y_mm * panel.slant_tan, y_mm, panel.viewing_distance_mm


def read_number(seen: np.ndarray, panel: Panel) -> int:
    """Return the number whose picture is most like the seen one."""
    rows, columns = ((np.arange(part) + 0.5) / part for part in seen.shape[:2])
    where = np.ix_((rows * panel.height_px).astype(int), (columns * panel.width_px).astype(int))
    grey = seen.mean(2) - seen.mean()
    likeness = {}
    for number in np.unique(displayed_numbers(panel)):
        expected = number_picture(panel, number)[where] * 1.0
        likeness[int(number)] = np.corrcoef(grey.ravel(), expected.ravel())[0, 1]
    return max(likeness, key=likeness.__getitem__)


def test_digits_look_like_digits():
    lines = ["".join(" #"[int(dot)] for dot in row).rstrip() for row in text_dots("42")]
    assert lines == ["", " # # ###", " # #   #", " ### ###", "   # #", "   # ###", ""]


@pytest.mark.filterwarnings("ignore::lightfield_gs.base.assumptions.Assumption")
@pytest.mark.parametrize("source", PANELS, ids=lambda source: Path(source).stem)
def test_five_eyes_read_their_numbers(source):
    panel = at_hand(source)
    image, shown = numbers(panel), displayed_numbers(panel)
    different = np.unique(shown)
    eyes = [different[round(share * (len(different) - 1))] for share in (0, 0.25, 0.5, 0.75, 1)]
    for number, y_mm in zip(eyes, (0, 20, -35, 0, 60)):
        seen = simulate(image, panel, eye_of(panel, number, y_mm))
        assert read_number(seen, panel) == number


def test_numbers_are_those_of_the_views():
    assert displayed_numbers(TOY).tolist() == list(range(8))
    panel = replace(TOY, views=96)  # 9.4 views a sub-pixel: numbers every twelfth, of the view in the middle
    assert np.unique(displayed_numbers(panel)).tolist() == [5, 17, 29, 41, 53, 65, 77, 89]
    assert displayed_numbers(panel, 1).tolist() == list(range(96))
    with pytest.raises(InputError, match="step must be 1..8, got 9"):
        numbers(TOY, 9)


@pytest.mark.parametrize("change", [{}, dict(invert_views=True), dict(subpixel_order="BGR")])
def test_patterns_follow_the_view_map(change):
    panel = replace(TOY, **change)
    views, x = panel.view_map(), panel.view_map(continuous=True)
    assert np.array_equal(
        lens_phases(panel, slice(0, 240), slice(0, 480)), np.concatenate([p for _, p in panel.phase_rows()])
    )
    assert np.array_equal(sweep(panel, hue=False), np.rint(255 * views / 7))
    assert np.array_equal(single(panel, 3, 4), 255 * ((views == 3) | (views == 4)))
    assert np.array_equal(sweep(panel)[views == 0].reshape(-1), np.where(np.nonzero(views == 0)[2] == 0, 255, 0))
    for shift in range(3):
        light = 0.5 + 0.45 * np.cos(2 * np.pi * (x / 8 - shift / 3))
        code = 1.055 * light ** (1 / 2.4) - 0.055  # never so dark that sRGB is linear
        assert np.array_equal(bars(panel, shift), np.rint(255 * code))
        assert np.array_equal(bars(panel)[..., shift], bars(panel, shift)[..., shift])


@pytest.mark.parametrize("source", ["toy-8v", "4k-71v"])
@pytest.mark.parametrize("parameter, span, off", [("pitch", 1.0, 0.5), ("slope", 6.0, -3.0), ("centre", 0.5, 0.25)])
def test_the_band_that_looks_right_says_the_change(source, parameter, span, off):
    started = at_hand(source)
    change = {"pitch": "pitch_percent", "slope": "slope_percent", "centre": "centre"}[parameter]
    true = changed(started, LensChange(**{change: off}))
    image = fan(started, parameter, span, bands=5)
    seen = simulate(image, true, (0, 0, true.viewing_distance_mm))
    bands = [band[2:-2, 2:-2] for band in np.array_split(seen, 5, axis=1 if parameter == "slope" else 0)]
    along = 0 if parameter == "slope" else 1
    if parameter == "centre":
        scores = [-np.median(band) for band in bands]
    else:
        scores = [np.median(np.abs(band - np.median(band, along, keepdims=True))) for band in bands]
    labels = np.linspace(-span, span, 5)
    assert labels[int(np.argmin(scores))] == pytest.approx(off)


@pytest.mark.parametrize("invert", [False, True])
def test_depth_ramp_moves_as_far_as_it_says(invert):
    """Content in front moves to the left when the eye goes to the right."""
    panel = replace(TOY, width_px=960, views=40, invert_views=invert)
    image = depth_ramp(panel, most_px=12, bands=3)
    right, left = (
        simulate(image, panel, eye_of(panel, view)).mean(2) for view in ((29.5, 9.5) if invert else (9.5, 29.5))
    )
    for band, disparity in ((0, 12), (1, 0), (2, -12)):
        a, b = (np.array_split(seen, 3)[band][-6:-2, 4:-4].mean(0) for seen in (right, left))
        spectrum = np.fft.rfft(a - a.mean()) * np.conj(np.fft.rfft(b - b.mean()))
        strongest = int(np.argmax(np.abs(spectrum)))
        lenses = np.angle(spectrum[strongest]) / (2 * np.pi) * len(a) / strongest  # that a lies to the left of b
        assert lenses * panel.line_number / 3 == pytest.approx(disparity / 2, abs=0.6)


def test_labels_are_numbers_without_exponents():
    """So that every band has one, whatever the span and the lens."""
    for span, expected in ((1e-6, "+0.0000002"), (0.5, "+0.1"), (50, "+10"), (1e5, "+20000")):
        assert _format_signed(span / 5, span) == expected
    panel = Panel(width_px=30, height_px=20, views=4096, line_number=9e5, slant_tan=0.1)
    assert depth_ramp(panel).shape == fan(panel, "pitch", span=1e-6, bands=99).shape == (20, 30, 3)
