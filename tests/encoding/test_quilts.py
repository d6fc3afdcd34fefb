"""Quilts out and in: names, tiles, and what a panel shows of views of any size and number."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from command_line import PANEL, complaint, run, scene

from lightfield_gs import InputError, Panel, QuiltLayout, encode, interlace, quilt, weave
from lightfield_gs.base.assumptions import Assumption
from lightfield_gs.encoding.weave_sampling import TorchPasses
from lightfield_gs.io.images import read_image, write_image
from lightfield_gs.panels.quilt import QUILT_PRESETS, panel_quilt, stated_layout, with_suffix
from lightfield_gs.panels.rig import Rig
from lightfield_gs.view_sets.view_set import QuiltViews, open_views

SIZE = PANEL.height_px, PANEL.width_px


def noise(*shape, dtype=np.uint8, seed=0):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def test_the_name_says_the_tiles():
    assert stated_layout("a_qs8x6a0.75.png") == QuiltLayout(8, 6, 0.75)
    assert stated_layout("a_qs8x6a0.75") == QuiltLayout(8, 6, 0.75)
    assert stated_layout("cat.png") is None
    assert with_suffix("cat", QUILT_PRESETS["go"]).name == "cat_qs11x6a0.5625.png"
    assert with_suffix("c_qs5x9a1.77.tif", QUILT_PRESETS["16-gen2"]).name == "c_qs5x9a1.77.tif"
    for name in ("a_qs8xa0.75.png", "a_qs0x6a0.75.png", "a_qs8x6a0.png"):
        with pytest.raises(InputError, match="name"):
            stated_layout(name)
    with pytest.raises(InputError, match="its name says _qs8x6a0.75, and the quilt is _qs11x6"):
        with_suffix("c_qs8x6a0.75.png", QUILT_PRESETS["go"])


def test_view_0_lies_at_the_bottom_left_then_right_then_up():
    pixels = np.arange(6, dtype=np.uint8).reshape(2, 3, 1)  # two rows of three tiles of one pixel
    views = QuiltViews(pixels, QuiltLayout(3, 2, 1), "quilt")
    assert [views.view(number)[0, 0, 0] for number in range(6)] == [3, 4, 5, 0, 1, 2]


def test_presets_fill_their_quilts_but_for_what_no_tile_takes():
    assert QUILT_PRESETS["portrait"].tile_px() == (420, 560)
    assert QUILT_PRESETS["16-gen2"].tile_px() == (819, 455)
    assert QUILT_PRESETS["16-gen2"].tile(0) == (slice(3641, 4096), slice(0, 819))
    assert panel_quilt(PANEL).views == PANEL.views and panel_quilt(PANEL).tile_px() == SIZE[::-1]


def test_numbers_of_views_without_factors_have_a_quilt_all_the_same():
    panel = Panel.load("65in-8k-96v")
    assert panel_quilt(panel).views == 96
    for views, columns, rows in ((97, 7, 14), (53, 6, 9), (94, 5, 19), (2, 1, 2)):
        odd = replace(panel, views=views)
        if columns * rows == views:
            found = panel_quilt(odd)
        else:
            with pytest.warns(Assumption, match=f"{columns} x {rows} = {columns * rows} views for the {views} of"):
                found = panel_quilt(odd)
        assert (found.columns, found.rows) == (columns, rows)
        assert panel_quilt(odd, (1, views)).views == views
    # Small tiles fit side by side: nothing is lost
    assert panel_quilt(replace(PANEL, views=13)).tile_px() == SIZE[::-1]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("inverted", [False, True])
def test_as_many_views_of_the_panels_size_are_interlaced(inverted, dtype):
    panel = replace(PANEL, invert_views=inverted)
    views = noise(PANEL.views, *SIZE, 3, dtype=dtype)
    in_order = views if inverted else views[::-1].copy()
    numbers = panel.view_map()
    expected = np.take_along_axis(in_order, numbers[None].astype(np.int64), 0)[0]
    assert np.array_equal(weave(views, panel).numpy(), expected)
    if dtype == np.uint8:
        assert torch.equal(weave(views, panel), interlace(torch.from_numpy(in_order), panel))


@pytest.mark.parametrize("interpolation", ["linear", "nearest"])
@pytest.mark.parametrize("place", ["integer", "continuous"])
def test_between_two_views_each_has_the_share_of_its_nearness(interpolation, place):
    """Plain views of brightness q: what is shown is where the sub-pixel stands among them."""
    count = 5
    views = np.ones((count, 4, 4, 3), np.float32) * np.arange(count, dtype=np.float32)[:, None, None, None]
    x = PANEL.view_map(continuous=place == "continuous") + (0.5 if place == "integer" else 0.0)
    at = np.clip(count * (1 - x / PANEL.views) - 0.5, 0, count - 1)
    got = weave(views, PANEL, interpolation=interpolation, place=place, fit="stretch").numpy()
    if interpolation == "linear":
        assert np.abs(got - at).max() < 1e-5
    else:
        assert np.abs(got - at).max() <= 0.5 + 1e-6 and set(np.unique(got)) <= set(range(count))


def ramp(width, height, count=12):
    """Views whose red is the position from the left, as a fraction of the view."""
    views = np.zeros((count, height, width, 3), np.float32)
    views[..., :] = ((np.arange(width) + 0.5) / width)[:, None]
    return views


def test_views_of_other_sizes_show_the_same_place():
    places = ((np.arange(PANEL.width_px) + 0.5) / PANEL.width_px)[:, None]
    for width, height in ((48, 30), (192, 120), (77, 48)):
        got = weave(ramp(width, height), PANEL).numpy()
        assert np.abs(got - places)[:, 4:-4].max() < 2e-3


def test_a_shift_moves_views_in_proportion_to_their_place():
    places = ((np.arange(PANEL.width_px) + 0.5) / PANEL.width_px)[:, None]
    left = 0.5 - (PANEL.view_map() + 0.5) / PANEL.views  # -1/2 at the left-most camera is 1/2 here negated
    got = weave(ramp(96, 60), PANEL, shift=0.2, fit="contain").numpy()
    expected = places - 0.2 * left
    within = (expected > 0.02) & (expected < 0.98)
    assert np.abs(got - expected)[within].max() < 2e-3
    assert (got[expected < -1e-3] == 0).all()
    covered = weave(ramp(96, 60) + 1, PANEL, shift=0.2).numpy()
    assert covered.min() >= 1  # nothing of the background shows


def test_cover_cuts_off_and_contain_leaves_bars():
    square = np.ones((12, 60, 60, 3), np.float32)
    assert weave(square, PANEL).numpy().min() == 1
    contained = weave(square, PANEL, fit="contain", background=(0, 0, 0.5)).numpy()
    assert (contained[:, :18] == (0, 0, 0.5)).all() and (contained[:, 18:-18] == 1).all()
    got = weave(ramp(96, 60), PANEL, crop=(0.5, 0, 0, 0), fit="stretch").numpy()
    assert got.min() > 0.49 and abs(got[:, 0].mean() - 0.5) < 0.01


def test_views_are_woven_in_groups_as_at_once(monkeypatch):
    from lightfield_gs.encoding import weave as module

    for views in (noise(7, 30, 48, 3), noise(PANEL.views, *SIZE, 3)):
        count = len(views)
        tiles = QuiltViews(views[::-1].reshape(-1, *views.shape[2:]), QuiltLayout(1, count, 1.6), "quilt")
        monkeypatch.setattr(module, "_GROUP_BYTES", 3 * views[0].size)
        for width in (0, 2.5):
            assert torch.equal(weave(tiles, PANEL, view_filter=width), weave(views, PANEL, view_filter=width))


@pytest.mark.parametrize("place", ["integer", "continuous"])
@pytest.mark.parametrize("interpolation", ["linear", "nearest"])
def test_torch_weaves_as_native_code_does(place, interpolation):
    """The weaving of CUDA tensors, here on the CPU."""
    for count, dtype, width in ((7, np.uint8, 0.0), (30, np.float32, 3.3), (12, np.uint16, 2.0)):
        views = noise(count, 34, 50, 3) if dtype == np.uint8 else noise(count, 34, 50, 3, dtype=np.uint16)
        views = (views / 65535).astype(np.float32) if dtype == np.float32 else views
        options = dict(place=place, interpolation=interpolation, view_filter=width, shift=0.1, fit="contain")
        got = weave(views, PANEL, **options).numpy()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("lightfield_gs.encoding.weave.NativePasses", lambda *of: TorchPasses(*of, "cpu"))
            expected = weave(views, PANEL, **options).numpy()
        assert np.abs(got.astype(np.float64) - expected).max() <= (1e-6 if dtype == np.float32 else 1)


@pytest.mark.parametrize("place", ["integer", "continuous"])
@pytest.mark.parametrize(("count", "width"), [(12, 2.0), (24, 1.0), (60, 2.7), (5, 4.0)])
def test_the_view_filter_is_the_mean_over_a_box_of_views(count, width, place):
    """Plain views, one of them bright: its weight is the fraction of the box nearest to it."""
    bright, box = count // 3, max(width * count / PANEL.views, 1.0)
    views = np.zeros((count, 4, 4, 3), np.float32)
    views[bright] = 1
    x = PANEL.view_map(continuous=place == "continuous") + (0.5 if place == "integer" else 0.0)
    at = np.clip(count * (1 - x / PANEL.views) - 0.5, 0, count - 1)
    shared = np.minimum(at + box / 2, bright + 0.5) - np.maximum(at - box / 2, bright - 0.5)
    got = weave(views, PANEL, place=place, view_filter=width, fit="stretch").numpy()
    assert np.abs(got - shared.clip(0) / box).max() < 1e-6


def test_the_view_filter_takes_detail_between_views_away_and_leaves_slow_change():
    """Waves across the views, f a view: a box of two halves those at 1/4, and none is left of 1/2."""
    q = np.arange(PANEL.views)
    for frequency in (0.0, 1 / 12, 1 / 4, 1 / 2):
        wave = np.cos(2 * np.pi * frequency * q).astype(np.float32)
        views = np.broadcast_to(wave[:, None, None, None], (PANEL.views, *SIZE, 3)).copy()
        at = PANEL.views - 1 - PANEL.view_map()
        got = weave(views, PANEL, view_filter=2).numpy()
        within = (at > 0) & (at < PANEL.views - 1)
        assert np.abs(got - np.cos(np.pi * frequency) ** 2 * wave[at])[within].max() < 1e-6
        assert np.array_equal(weave(views, PANEL, view_filter=1).numpy(), wave[at])


def test_a_view_map_takes_the_place_of_the_lens():
    views = noise(3, *SIZE, 3)
    table = np.random.default_rng(1).integers(-1, 3, (*SIZE, 3)).astype(np.int32)
    got = weave(views, PANEL, view_map=table, background=(1, 1, 1)).numpy()
    expected = np.take_along_axis(views[::-1], table.clip(0)[None].astype(np.int64), 0)[0]
    assert np.array_equal(got, np.where(table < 0, 255, expected))


@pytest.mark.parametrize("width", [0.0, 1.5])
@pytest.mark.parametrize("inverted", [False, True])
def test_the_weave_of_a_quilt_is_what_classic_draws(inverted, width):
    panel = replace(PANEL, invert_views=inverted)
    gaussians, layout = scene(), panel_quilt(panel)
    rig = Rig.frame(gaussians, panel)
    image = quilt(gaussians, layout, rig, panel, view_filter=width).numpy()
    got = weave(QuiltViews(image, layout, "quilt"), panel)
    difference = (got.int() - encode(gaussians, panel, rig, "classic", view_filter=width).int()).abs()
    assert difference.max() <= (1 if inverted else 0)  # mirrored offsets may differ in the last bit


def test_commands_make_the_picture_of_classic(folder, capsys):
    run(capsys, "encode s.ply -o c.png --panel p.yaml --method classic")
    words = run(capsys, "quilt s.ply -o q --panel p.yaml --save-rig r.yaml --save-rgbd q --tiles 4x3")
    assert "q_qs4x3a1.6.png: 12 views of 96 x 60 pixels" in words and "--depth-range" in words
    words = run(capsys, "weave q_qs4x3a1.6.png --panel p.yaml -o w.png")
    assert "every sub-pixel is that of one view" in words
    assert np.array_equal(read_image("w.png", True), read_image("c.png", True))
    run(capsys, "simulate w.png --eye 0,0,600 -o e.png")


def test_rgbd_comes_back_with_its_depths(folder, capsys):
    words = run(capsys, "quilt s.ply -o q --preset portrait --size 480x480 --save-rgbd q.png")
    picture = read_image("q_rgbd.png", True)
    assert picture.shape == (80, 120, 3) and picture[:, 60:].max() == 255 and picture[:, 60:].min() == 0
    assert (picture[:, 60:] == picture[:, 60:, :1]).all()
    option = words.split("read it with ")[1].splitlines()[0]
    run(capsys, f"encode q_rgbd.png --rgbd right {option} --panel p.yaml -o back.png")


def test_folders_and_light_fields_are_read_from_left_to_right(tmp_path):
    def write(name, value):
        write_image(tmp_path / name, np.full((4, 6, 3), value, np.uint8))

    def shown(path, **options):
        views = open_views(path, **options).views
        return [int(views.view(number)[0, 0, 0]) for number in range(views.count)]

    for kind in ("row", "hci", "stanford"):
        (tmp_path / kind).mkdir()
    for number in range(8, 12):
        write(f"row/view{number}.png", number)
    assert shown(tmp_path / "row") == [8, 9, 10, 11]
    assert shown(tmp_path / "row", right_to_left=True) == [11, 10, 9, 8]
    (tmp_path / "hci/parameters.cfg").write_text("[extrinsics]\nnum_cams_x = 3\nnum_cams_y = 3\n")
    for number in range(9):
        write(f"hci/input_Cam{number:03}.png", number)
    write("hci/objectids.png", 99)
    assert shown(tmp_path / "hci") == [3, 4, 5] and shown(tmp_path / "hci", row=0) == [0, 1, 2]
    for row in range(3):
        for column in range(4):
            write(f"stanford/out_{row:02}_{column:02}_-381.9_1103.3.png", 10 * row + column)
    with pytest.warns(UserWarning, match="left to right"):
        assert shown(tmp_path / "stanford") == [10, 11, 12, 13]
    (tmp_path / "row/view9.png").unlink()
    with pytest.raises(InputError, match="numbered 8..11, and 9 is missing"):
        open_views(tmp_path / "row")
    write_image(tmp_path / "row/view9.png", np.zeros((4, 7, 3), np.uint8))
    with pytest.raises(InputError, match="view9.png: expected 6 x 4 pixels as view8.png has, got 7 x 4"):
        open_views(tmp_path / "row")
    (tmp_path / "hci/input_Cam004.png").unlink()
    with pytest.raises(InputError, match="row 1, column 1 is missing"):
        open_views(tmp_path / "hci")


def test_bad_input_is_told_in_one_line(folder, capsys):
    write_image("plain.png", noise(12, 12, 3))
    write_image("odd_qs5x2a1.png", noise(12, 12, 3))
    (folder / "empty").mkdir()
    for line, words in (
        ("weave plain.png --panel p.yaml -o w.png", "give --tiles COLUMNSxROWS"),
        ("weave odd_qs5x2a1.png --panel p.yaml -o w.png", "12 x 12 pixels do not divide into 5 x 2 tiles"),
        ("weave plain.png --tiles 13x1 --panel p.yaml -o w.png", "too few for 13 x 1"),
        ("weave absent_qs2x2a1.png --panel p.yaml -o w.png", "cannot read absent_qs2x2a1.png"),
        ("weave empty --panel p.yaml -o w.png", "expected a picture for each view, found none"),
        ("weave empty --tiles 2x2 --panel p.yaml -o w.png", "expected a picture for each view, found none"),
        ("weave plain.png --tiles 2x2 --row 1 --panel p.yaml -o w.png", "--row is about the cameras of a folder"),
        ("weave plain.png --tiles 2x2 --crop 0.6,0,0.6,0 --panel p.yaml -o w.png", "leave nothing"),
        ("weave plain.png --tiles 2x2 --panel p.yaml -o w.jpg", "expected the extension"),
        ("quilt s.ply -o q --size 100x100 --tiles 3x3", "100 x 100 pixels do not divide"),
        ("quilt s.ply -o q_qs2x2a1.png --preset go", "its name says _qs2x2a1"),
        ("quilt s.ply -o q --preset go --panel p.yaml", "--panel takes the place of --preset"),
        ("quilt s.ply -o q.exr --preset go", "8 bits"),
        ("quilt s.ply -o q --preset go --depth-report", "about the lens of a --panel"),
    ):
        assert words in complaint(capsys, line)
