"""An eye sees, at every position, the view that the geometry of the lens demands."""

import math

import numpy as np
import pytest
from panel_cases import TEMPLATE_LENS
from rasterizer_cases import CELLS

from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.simulate import Psf, eye_row, simulate, simulate_eyes

BASE = dict(
    TEMPLATE_LENS,
    width_px=600,
    height_px=300,
    views=96,
    phase=-2161.2,
    cone_deg=40,
    viewing_distance_mm=2000,
    pixel_pitch_mm=0.19,
)
KINDS = [
    {},
    dict(slant_tan=-0.18, subpixel_order="BGR", phase=7.3),
    dict(slant_tan=0.0, line_number=16.01),
    dict(cone_deg=15, line_number=4.2),
    dict(width_px=397, height_px=131),
    dict(subpixel_cells=CELLS, cell_pattern=2, line_number=19.17),
    dict(subpixel_cells=CELLS, cell_pattern=1),
]


def views_seen(panel: Panel, eye, **options) -> np.ndarray:
    """x that the eye sees on every lens, when each sub-pixel has x/N as its colour."""
    picture = simulate(panel.view_map(continuous=True) / panel.views, panel, eye, **options)
    return picture * panel.views


@pytest.mark.parametrize("change", KINDS)
@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.parametrize("eye", [(0, 0), (31.5, 0), (-31.5, 0), (120, 0), (60, 200), (-90, -150)])
def test_at_the_viewing_distance_one_view_fills_the_panel(change, invert, eye):
    panel = Panel(**{**BASE, **change, "invert_views": invert})
    zone_mm = 2 * 2000 * math.tan(math.radians(panel.cone_deg) / 2)
    xi = (eye[0] - eye[1] * panel.slant_tan) * (-1 if invert else 1)
    expected = panel.views * (0.5 - xi / zone_mm)
    seen = views_seen(panel, (*eye, 2000), spread_subpixels=0.6)
    inner = seen[2:-2, 2:-2]
    assert inner.mean() == pytest.approx(expected, abs=0.02 * panel.views)
    # A lens shows a view every 1/P_e of the cone; a patch of a few lenses is never further off than that.
    assert np.abs(inner - expected).max() < panel.views / panel.line_number


@pytest.mark.parametrize("change", KINDS)
def test_the_picture_is_the_same_in_any_chunks(change, monkeypatch):
    panel = Panel(**{**BASE, **change})
    image = np.random.default_rng(0).integers(0, 255, (panel.height_px, panel.width_px, 3), np.uint8)
    whole = simulate(image, panel, (30, 10, 1900), threads=1)
    for rows, cell_rows in ((1, 1), (40, 7), (1000, 1000)):
        monkeypatch.setattr("lightfield_gs.panels.simulate._ROWS_PER_CHUNK_PX", rows)
        monkeypatch.setattr("lightfield_gs.panels.simulate._CELL_ROWS_PER_CHUNK", cell_rows)
        assert np.array_equal(simulate(image, panel, (30, 10, 1900), threads=2), whole)


def test_right_eye_sees_small_views():
    panel = Panel(**BASE)
    right, left = (views_seen(panel, (x, 0, 2000)).mean() for x in (31.5, -31.5))
    assert right < 48 < left


def test_zones_repeat():
    panel = Panel(**BASE)
    zone_mm = 2 * 2000 * math.tan(math.radians(20))
    assert views_seen(panel, (zone_mm + 50, 0, 2000)) == pytest.approx(views_seen(panel, (50, 0, 2000)), abs=0.5)


@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.parametrize("z", [1400.0, 3000.0])
def test_nearer_or_farther_the_view_drifts_as_rays_demand(z, invert):
    """An eye at (0, 0, z) sees a lens at X in the direction of an eye at X (1 - L/z) at viewing distance L."""
    panel = Panel(
        **{**BASE, "slant_tan": 0.0, "line_number": 9.85, "width_px": 3000, "height_px": 40, "invert_views": invert}
    )
    seen = views_seen(panel, (0, 0, z))[1:-1].mean((0, 2))
    lenses_mm = (np.arange(len(seen)) + 0.5 - len(seen) / 2) * 3000 * 0.19 / len(seen)
    zone_mm = 2 * 2000 * math.tan(math.radians(20))
    expected = 96 * (0.5 - (-1 if invert else 1) * lenses_mm * (1 - 2000 / z) / zone_mm)
    kept = slice(20, -20)
    assert np.polyfit(lenses_mm[kept], seen[kept], 1)[0] == pytest.approx(
        np.polyfit(lenses_mm[kept], expected[kept], 1)[0], rel=0.03
    )
    assert np.abs(seen - expected)[kept].mean() < 2


def test_a_picture_per_view_comes_out_whole():
    """Interlaced from two pictures, left half of the views and right half, each eye gets its own, in its place."""
    panel = Panel(**BASE)
    rows, columns = np.mgrid[0:300, 0:600]
    square = (abs(rows - 80) < 40) & (abs(columns - 450) < 40)
    image = np.where((panel.view_map() < 48), square[..., None], 1 - 0.5 * square[..., None])
    right, left = (simulate((255 * image).astype(np.uint8), panel, (x, 0, 2000)) for x in (300, -300))
    assert right.shape == (round(900 / BASE["line_number"]), round(1800 / BASE["line_number"]), 3)
    centre = int(80 / 300 * right.shape[0]), int(450 / 600 * right.shape[1])
    assert right[centre].min() > 0.95 and right[-8, 8].max() < 0.05
    assert abs(left[centre] - 0.5).max() < 0.05 and left[-8, 8].min() > 0.95


def test_crosstalk_mixes_views():
    panel = Panel(**BASE)
    image = (panel.view_map() < 48).astype(np.float32)
    sharp, blurred = (simulate(image, panel, (150, 0, 2000), spread)[3:-3, 3:-3].mean() for spread in (1, 4))
    assert sharp > 0.97 and 0.6 < blurred < 0.95


MEASURED = ((-4.0, -1.5, 0.0, 0.5, 2.0, 9.0), (0.1, 0.3, 7.0, 6.0, 0.5, 0.0))


@pytest.mark.parametrize("unit", [1.0, 250.0])
def test_a_measured_spread_of_light_in_closed_form(unit):
    """Upright lenses of two pixels, so that each colour has two sub-pixels on every lens.

    The eye in the middle sees the sub-pixel at place D of its lens at the offset D - 3, or farther by whole lenses.
    """
    panel = Panel(**{**BASE, "line_number": 6.0, "slant_tan": 0.0, "phase": 0.25})
    image = np.zeros((300, 600, 3), np.float32)
    image[:, ::2] = 1
    offsets, light = MEASURED
    seen = simulate(image, panel, (0, 0, 2000), psf=Psf(offsets, tuple(unit * value for value in light)))
    for channel in range(3):
        first, second = (
            sum(np.interp(place - 3 + 6 * lens, offsets, light, left=0, right=0) for lens in (-2, -1, 0, 1, 2))
            for place in (channel + 0.25, channel + 3.25)
        )
        assert seen[3:-3, 3:-3, channel] == pytest.approx(first / (first + second), abs=1e-5)


def test_a_measured_gaussian_is_the_usual_spread():
    panel, offsets = Panel(**BASE), np.linspace(-4.9, 4.9, 2001)
    light = np.exp(-4 * math.log(2) * offsets**2 / 1.5**2)
    image = np.random.default_rng(0).random((300, 600, 3))
    usual = simulate(image, panel, (40, 10, 1900), 1.5)
    assert np.abs(simulate(image, panel, (40, 10, 1900), psf=Psf(tuple(offsets), tuple(light))) - usual).max() < 1e-3


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "2..4096 numbers"),
        ("0 1\n1 x\n", "line 2: expected an offset"),
        ("0 1\n1 2 3\n", "line 2: expected an offset"),
        ("0 1\n0 2\n", "must ascend"),
        ("0 0\n1 0\n", "all light is 0"),
        ("0 -1\n1 2\n", "light must be 0"),
        ("0 nan\n1 2\n", "light must be 0"),
        ("0 1\n1e9 2\n", "offsets must be"),
    ],
)
def test_a_file_of_a_spread_that_makes_no_sense_is_refused(tmp_path, text, words):
    path = tmp_path / "lens.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=f"lens.csv.*{words}"):
        Psf.load(path)


def test_the_file_of_a_measured_spread(tmp_path):
    path = tmp_path / "lens.csv"
    path.write_text("# lens 7, 12 June\n" + "\n".join(f"{a}, {b}" for a, b in zip(*MEASURED)) + "\n\n")
    assert Psf.load(path) == Psf(*MEASURED)
    with pytest.raises(InputError, match="leave out one"):
        simulate(np.zeros((300, 600, 3)), Panel(**BASE), (0, 0, 2000), 2.0, psf=Psf(*MEASURED))


def test_a_row_of_eyes_sees_what_each_of_them_sees():
    panel = Panel(**BASE)
    eyes = eye_row(panel, -90, 60, 4)
    assert eyes.tolist() == [[-90, 0, 2000], [-40, 0, 2000], [10, 0, 2000], [60, 0, 2000]]
    image = np.random.default_rng(0).random((300, 600, 3))
    pictures = simulate_eyes(image, panel, eyes)
    assert all(np.array_equal(picture, simulate(image, panel, eye)) for picture, eye in zip(pictures, eyes.tolist()))
    for count, words in ((0, "1..1000"), (1.5, "whole number")):
        with pytest.raises(InputError, match=words):
            eye_row(panel, 0, 1, count)


def test_number_types_agree_and_white_is_white():
    panel = Panel(**BASE)
    values = np.random.default_rng(0).random((300, 600, 3))
    pictures = [
        simulate(image, panel, (10, 0, 1900))
        for image in (values, (values * 255).round().astype(np.uint8), (values * 65535).round().astype(np.uint16))
    ]
    assert np.abs(pictures[0] - pictures[1]).max() < 0.003 and np.abs(pictures[0] - pictures[2]).max() < 1e-4
    assert simulate(np.ones((300, 600, 4), np.float32), panel, (0, 0, 700)) == pytest.approx(1)


@pytest.mark.parametrize(
    "image, change, eye, words",
    [
        (np.zeros((10, 10, 3)), {}, (0, 0, 2000), "10 x 10"),
        (np.zeros((300, 600)), {}, (0, 0, 2000), "H, W, 3"),
        (np.zeros((300, 600, 3), bool), {}, (0, 0, 2000), "bool"),
        (None, {}, (0, 0, 0), "above 0"),
        (None, {}, (0, 0, -5), "above 0"),
        (None, {}, (0, math.nan, 5), "eye: y"),
        (None, {}, (0, 0), "three numbers"),
        (None, dict(viewing_distance_mm=None), (0, 0, 9), "lacks viewing_distance_mm"),
        (None, dict(pixel_pitch_mm=None), (0, 0, 9), "lacks pixel_pitch_mm"),
        (None, dict(invert_views=True), (0, 0, 0.1), "lens gap"),
    ],
)
def test_nonsense_is_refused(image, change, eye, words):
    with pytest.raises(InputError, match=words):
        simulate(np.zeros((300, 600, 3)) if image is None else image, Panel(**{**BASE, **change}), eye)
