"""The panel: published vectors, exactness of the fixed-point phase, files, and what it refuses."""

import json
import math
from fractions import Fraction

import numpy as np
import pytest
import rasterizer_cases
from hypothesis import given, settings
from hypothesis import strategies as st

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.text_files import config_names
from lightfield_gs.panels.panel import Panel

TOY = dict(
    width_px=8,
    height_px=7,
    views=8,
    lens_pitch_mm=0.60,
    slant_tan=1 / 6,
    viewing_distance_mm=1000,
    lens_gap_mm=2,
    pixel_pitch_mm=3 * 0.06,
)
TEMPLATE = {"pitch": 42, "slope": -6, "center": 0.3, "DPI": 136, "screenW": 7680, "screenH": 4320}


def exact_x(panel: Panel, i: int, j: int, k: int) -> Fraction:
    """x by the formula, in exact arithmetic."""
    d = 3 * j + 3 * i * Fraction(panel.slant_tan) + k + Fraction(panel.phase)
    turns = d / Fraction(panel.line_number)
    return (turns - math.floor(turns)) * panel.views


def test_toy_lens():
    panel = Panel.from_physical(**TOY)
    assert f"{panel.line_number:.12f}" == "10.158213425598"
    views = panel.view_map()
    assert views.dtype == np.int32 and views.shape == (7, 8, 3)
    assert views[0].tolist() == [[0, 0, 1], [2, 3, 3], [4, 5, 6], [7, 7, 0], [1, 2, 3], [3, 4, 5], [6, 6, 7], [0, 1, 2]]
    assert views[1, :4].tolist() == [[0, 1, 1], [2, 3, 4], [5, 5, 6], [7, 0, 1]]
    assert views[6, :3].tolist() == [[2, 3, 3], [4, 5, 6], [7, 7, 0]]


@pytest.mark.parametrize(
    "index, printed",
    [
        ((0, 3, 1), "7.875401"),
        ((0, 3, 2), "0.662941"),
        ((1, 0, 0), "0.393770"),
        ((2, 1, 0), "3.150160"),
        ((6, 7, 2), "4.476042"),
    ],
)
def test_toy_lens_continuous(index, printed):
    assert f"{Panel.from_physical(**TOY).view_map(continuous=True)[index]:.6f}" == printed


def test_looking_glass_template(tmp_path):
    path = tmp_path / "visual.json"
    path.write_text(json.dumps({"configVersion": "3.0", **{key: {"value": v} for key, v in TEMPLATE.items()}}))
    panel = Panel.load(path)
    assert panel == Panel.from_looking_glass(TEMPLATE)
    assert (panel.width_px, panel.height_px, panel.views) == (7680, 4320, 96)
    assert f"{panel.line_number:.12f}" == "9.848282191911"
    assert f"{panel.phase:.12f}" == "-2161.204484657574"
    assert panel.pixel_pitch_mm == 25.4 / 136
    x = panel.view_map(continuous=True)
    for (col, row), printed in {
        (0, 0): "43.18984 33.44195 23.69405",
        (1, 0): "13.94616 4.19827 90.45037",
        (0, 1): "38.31589 28.56800 18.82011",
        (3840, 2160): "3.73937 89.99148 80.24358",
    }.items():
        assert " ".join(f"{96 - value:.5f}" for value in x[row, col]) == printed


CELLS = [
    {f"{colour}Offset{axis}": value for colour, place in zip("RGB", cell) for axis, value in zip("XY", place)}
    for cell in rasterizer_cases.CELLS
]
THIRD = {
    "pitch": 44.750583,
    "slope": -6.874566,
    "center": 0.169358,
    "DPI": 283,
    "screenW": 3840,
    "screenH": 2160,
    "CellPatternMode": 2,
    "subpixelCells": CELLS,
}


def test_looking_glass_of_the_third_generation():
    lkg = 47 - Panel.from_looking_glass(THIRD, views=48).view_map()
    for (col, row), printed in {
        (0, 0): [14, 10, 11],
        (1, 0): [6, 1, 4],
        (0, 1): [13, 8, 10],
        (1, 1): [5, 0, 3],
        (100, 50): [24, 20, 21],
    }.items():
        assert lkg[row, col].tolist() == printed


def looking_glass_views(calibration, cell, views, col, row, channel):
    """N (1 - frac(a)) by the formula of Looking Glass' shaders; cell: which one a pixel is."""
    c = {key: float(value) for key, value in calibration.items() if key != "subpixelCells"}
    w, h, sign = c["screenW"], c["screenH"], -1 if c.get("flipImageX") else 1
    u, v, tilt = (col + 0.5) / w, (h - row - 0.5) / h, sign * h / (w * c["slope"])
    if calibration.get("subpixelCells"):
        cells = np.array(
            [
                [[one[f"{colour}Offset{axis}"] for axis in "XY"] for colour in "RGB"]
                for one in calibration["subpixelCells"]
            ]
        )
        x, y = cells[cell, channel].T
        u, v = u + x / w, v + y / h
    else:
        u = u + (2 - channel if c.get("flipSubp") else channel) * sign / (3 * w)
    a = (u + v * tilt) * c["pitch"] * w / c["DPI"] * math.cos(math.atan(1 / c["slope"])) - c["center"]
    return views * (1 - (a - np.floor(a)))


@pytest.mark.parametrize(
    "change, cell",
    [
        ({}, lambda x, y: x % 2),
        ({"CellPatternMode": 0}, lambda x, y: 0 * x),
        ({"CellPatternMode": 1}, lambda x, y: (x + y) % 2),
        ({"CellPatternMode": 4}, lambda x, y: y % 2),
        ({"CellPatternMode": 3, "subpixelCells": CELLS + CELLS[::-1]}, lambda x, y: (y + 2 * (x % 2)) % 4),
        ({"flipImageX": 1}, lambda x, y: x % 2),
        ({"subpixelCells": [], "CellPatternMode": 0}, None),
        ({"subpixelCells": [], "CellPatternMode": 0, "flipImageX": 1}, None),
        ({"subpixelCells": [], "CellPatternMode": 0, "flipImageX": 1, "flipSubp": 1}, None),
    ],
)
def test_looking_glass_formula(change, cell):
    calibration = {**THIRD, **change}
    panel = Panel.from_looking_glass(calibration, views=48)
    random = np.random.default_rng(0)
    col, row, channel = (random.integers(0, size, 200_000) for size in (3840, 2160, 3))
    number = None if cell is None else cell(col, 2159 - row)
    want = looking_glass_views(calibration, number, 48, col, row, channel)
    away = (48 - panel.view_map(continuous=True)[row, col, channel] - want + 24) % 48 - 24
    assert np.abs(away).max() < 1e-9


def test_a_mirrored_looking_glass_may_gain_half_a_lens():
    mirrored = {**TEMPLATE, "flipImageX": 1}
    plain, moved = (
        Panel.from_looking_glass(mirrored, flip_center=by).view_map(continuous=True)[0, 0, 0] for by in (0, 0.5)
    )
    assert (moved - plain) % 96 == pytest.approx(48)


def test_cells_come_back_from_their_file(tmp_path):
    panel = Panel.from_looking_glass(THIRD)
    panel.to_yaml(tmp_path / "cells.yaml")
    assert Panel.load(tmp_path / "cells.yaml") == panel
    stripes = Panel.load("toy-8v")
    assert "subpixel_cells" not in stripes.to_dict()


def test_looking_glass_options_and_errors():
    options = {**TEMPLATE, "viewCone": 54, "flipSubp": 1, "invView": 1}
    panel = Panel.from_looking_glass(options, views=48)
    assert (panel.views, panel.cone_deg, panel.subpixel_order, panel.invert_views) == (48, 54, "BGR", False)
    assert Panel.from_looking_glass({**TEMPLATE, "invView": 0}).invert_views
    for change, word in (
        ({"pitch": "x"}, "pitch"),
        ({"DPI": 0}, "DPI"),
        ({"slope": 0}, "slope"),
        ({"flipImageY": 1}, "flipImageY"),
        ({"fringe": 0.5}, "fringe"),
        ({"verticalAngle": 1.57}, "verticalAngle"),
        ({"center": math.nan}, "center"),
        ({"CellPatternMode": 7}, "CellPatternMode 7 is not known"),
        ({"CellPatternMode": 2}, "no subpixelCells"),
        ({"subpixelCells": [{}]}, "missing ROffsetX"),
        ({"subpixelCells": "none"}, "must be a list"),
        ({"subpixelCells": [3]}, "must be an object"),
        ({"subpixelCells": CELLS, "CellPatternMode": 3}, "needs 4"),
        ({"subpixelCells": CELLS, "flipSubp": 1}, "flipSubp"),
        ({"screenW": 0}, "width_px"),
    ):
        with pytest.raises(InputError, match=word):
            Panel.from_looking_glass({**TEMPLATE, **change})
    with pytest.raises(InputError, match="missing pitch"):
        Panel.from_looking_glass({key: value for key, value in TEMPLATE.items() if key != "pitch"})


def test_default_panel_is_the_template_lens():
    panel = Panel.from_yaml("65in-8k-96v")
    assert (panel.width_px, panel.height_px, panel.views, panel.cone_deg) == (7680, 3840, 96, 40)
    assert (panel.line_number, panel.phase, panel.slant_tan) == (9.848282191911, -2161.204484657574, 1 / 6)
    assert panel.pixel_pitch_mm == 25.4 / 136 and panel.viewing_distance_mm == 2000


@pytest.mark.parametrize(
    "name, measures",
    [
        ("4k-71v", dict(lens_pitch_mm=0.48, lens_gap_mm=0.55, viewing_distance_mm=600, pixel_pitch_mm=0.09)),
        ("toy-8v", dict(lens_pitch_mm=0.6, lens_gap_mm=2, viewing_distance_mm=1000, pixel_pitch_mm=0.18)),
    ],
)
def test_profile_follows_from_its_measures(name, measures):
    panel = Panel.load(name)
    made = Panel.from_physical(
        width_px=panel.width_px, height_px=panel.height_px, views=panel.views, slant_tan=1 / 6, name=name, **measures
    )
    assert panel == made


def test_all_profiles_load():
    assert set(config_names("panels")) >= {"65in-8k-96v", "4k-71v", "toy-8v"}
    assert all(Panel.load(name).name == name for name in config_names("panels"))


PANELS = st.builds(
    Panel,
    width_px=st.integers(1, 40),
    height_px=st.integers(1, 40),
    views=st.integers(1, 200),
    line_number=st.one_of(st.floats(0.5, 60), st.integers(1, 20).map(float)),
    slant_tan=st.floats(-1, 1),
    phase=st.one_of(st.floats(-1e5, 1e5), st.integers(-100, 100).map(float)),
    subpixel_order=st.sampled_from(["RGB", "BGR"]),
)


@settings(max_examples=150, deadline=None)
@given(PANELS, st.data())
def test_view_map_is_the_formula(panel, data):
    i = data.draw(st.integers(0, panel.height_px - 1))
    j = data.draw(st.integers(0, panel.width_px - 1))
    views, positions = panel.view_map(), panel.view_map(continuous=True)
    for channel in range(3):
        place = channel if panel.subpixel_order == "RGB" else 2 - channel
        x = exact_x(panel, i, j, place)
        slack = panel.views * 2.0**-45
        turns = (Fraction(float(positions[i, j, channel])) - x) / panel.views
        assert abs(turns - round(turns)) * panel.views <= slack
        if math.floor(x) == math.floor(x + Fraction(slack)):
            assert views[i, j, channel] == math.floor(x)
    assert 0 <= views.min() and views.max() < panel.views
    assert 0 <= positions.min() and positions.max() < panel.views


@pytest.mark.parametrize("line_number, views", [(3.0, 3), (6.0, 6), (7.0, 7), (9.0, 9), (12.0, 4)])
def test_borders_between_views_belong_to_the_upper_view(line_number, views):
    panel = Panel(width_px=50, height_px=20, views=views, line_number=line_number, slant_tan=1.0, phase=-5)
    d = 3 * np.arange(50)[:, None] + np.arange(3) + 3 * np.arange(20)[:, None, None] - 5
    assert np.array_equal(panel.view_map(), d % int(line_number) * views // int(line_number))


def test_the_far_corner_of_the_largest_panel_is_exact():
    panel = Panel(width_px=65536, height_px=65536, views=96, line_number=9.848282191911, slant_tan=-0.18, phase=1e6 / 7)
    s0, sx, sy = panel.phase_steps()
    phase = (s0 + sx * (3 * 65535 + 2) + sy * 65535) % 2**64
    x = exact_x(panel, 65535, 65535, 2)
    assert 0 <= Fraction(phase * 96, 2**64) - x < Fraction(96, 2**45)


def test_positions_stay_below_the_number_of_views():
    for views in (1, 3, 96, 65536):
        panel = Panel(width_px=1, height_px=1, views=views, line_number=9.0, slant_tan=0)
        top = np.array([2**64 - 1], np.uint64)
        assert panel.view_position(top)[0] < views and panel.view_index(top)[0] == views - 1


def test_bgr_mirrors_the_places():
    panel = Panel.from_physical(**TOY)
    mirrored = Panel.from_physical(**TOY, subpixel_order="BGR")
    assert np.array_equal(panel.view_map()[..., ::-1], mirrored.view_map())


def test_yaml_round_trip(tmp_path):
    panel = Panel(
        width_px=123,
        height_px=45,
        views=6,
        line_number=1e-3 / 3 + 7,
        slant_tan=-1e-05,
        phase=-1 / 3e7,
        subpixel_order="BGR",
        invert_views=True,
        cone_deg=1 / 3,
        name="odd one",
    )
    panel.to_yaml(tmp_path / "p.yaml")
    assert Panel.load(tmp_path / "p.yaml") == panel


def test_yaml_without_the_optional_fields(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text("width_px: 3\nheight_px: 2\nviews: 4\nline_number: 5\nslant_tan: 0\n")
    panel = Panel.load(str(path))
    assert panel.viewing_distance_mm is None and panel.name == "small" and panel.subpixel_order == "RGB"


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(width_px=0), "width_px"),
        (dict(width_px=70000), "width_px"),
        (dict(height_px=-3), "height_px"),
        (dict(height_px=1.5), "whole number"),
        (dict(views=0), "views"),
        (dict(views=math.nan), "views"),
        (dict(views=math.inf), "views"),
        (dict(views=True), "views"),
        (dict(line_number=0), "line_number"),
        (dict(line_number=-9.8), "line_number"),
        (dict(line_number=math.nan), "line_number"),
        (dict(line_number=math.inf), "line_number"),
        (dict(line_number="wide"), "line_number"),
        (dict(line_number=None), "line_number"),
        (dict(slant_tan=99), "slant_tan"),
        (dict(phase=math.nan), "phase"),
        (dict(cone_deg=0), "cone_deg"),
        (dict(cone_deg=180), "cone_deg"),
        (dict(subpixel_order="GRB"), "subpixel_order"),
        (dict(invert_views="no"), "invert_views"),
        (dict(viewing_distance_mm=0), "viewing_distance_mm"),
        (dict(pixel_pitch_mm=-1), "pixel_pitch_mm"),
        (dict(cell_pattern=1), "without subpixel_cells"),
        (dict(subpixel_cells=[[0, 1, 2]]), "subpixel_cells"),
        (dict(subpixel_cells="RGB"), "subpixel_cells"),
        (dict(subpixel_cells=rasterizer_cases.CELLS, cell_pattern=5), "cell_pattern"),
        (dict(subpixel_cells=rasterizer_cases.CELLS, cell_rule="apple"), "cell_rule"),
        (dict(subpixel_cells=rasterizer_cases.CELLS, cell_rows=0), "cell_rows"),
        (dict(subpixel_cells=rasterizer_cases.CELLS, subpixel_order="BGR"), "subpixel_order"),
    ],
)
def test_nonsense_is_refused(change, words):
    good = dict(width_px=8, height_px=7, views=8, line_number=10.0, slant_tan=0.1)
    with pytest.raises(InputError, match=words) as caught:
        Panel(**{**good, **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text, words",
    [
        ("width: 3\n", "did you mean 'width_px'"),
        ("[1, 2]\n", "mapping"),
        ("a: [", "not YAML"),
        ("", "mapping"),
        ("width_px: 3\nheight_px: 2\nviews: 4\nslant_tan: 0\n", "missing line_number"),
        ("width_px: 3\nheight_px: 2\nviews: 4\nviews: 5\nline_number: 5\nslant_tan: 0\n", "'views' twice"),
        ("width_px: 010\n", "'010' is a different number"),
        ("width_px: 1:30\n", "'1:30' is a"),
        ("line_number: 1_0.5\n", "'1_0.5' is a"),
        ("width_px: &a [1]\nheight_px: *a\n", "aliases"),
    ],
)
def test_bad_yaml(tmp_path, text, words):
    path = tmp_path / "p.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        Panel.load(path)
    assert "\n" not in str(caught.value)


def test_unknown_name_lists_the_nearest():
    with pytest.raises(InputError, match="did you mean '65in-8k-96v'"):
        Panel.load("65in-8k-96")
    with pytest.raises(InputError, match="cannot read"):
        Panel.load("no/such/file.yaml")
