"""Pictures of two eyes: which eye sees what from where, their layouts, and the files that players read."""

import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import complaint
from PIL import Image

from lightfield_gs import Gaussians, cli
from lightfield_gs.encoding.stereo import join_eyes, render_eyes
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.io.pillow_images import count_pictures
from lightfield_gs.io.stereo_names import layout_in_name, stereo_paths
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.stereo_screen import StereoScreen, eye_geometry

SCREEN = StereoScreen(96, 54)
RIG = Rig(np.eye(4), (80.0, 80.0), (48.0, 27.0), 2.0)


def balls(*places: tuple[float, float, float]) -> Gaussians:
    """Red, green, ... balls at these places."""
    count = len(places)
    sh = torch.full((count, 1, 3), -1.8)
    sh[range(count), 0, range(count)] = 1.8
    return Gaussians(
        torch.tensor(places),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), 0.05),
        torch.full((count,), 0.99),
        sh,
    )


def columns(picture: torch.Tensor) -> list[float]:
    """The middles of red and green in a picture before black."""
    weights = picture.double().sum(0).numpy()
    return [
        float((weights[:, part] * (np.arange(len(weights)) + 0.5)).sum() / weights[:, part].sum()) for part in (0, 1)
    ]


def test_each_eye_sees_the_scene_from_its_own_side():
    """Near things are to the right for the left eye; a thing in the screen's plane does not move."""
    left, right = render_eyes(balls((-0.3, 0, 1.5), (0.3, 0, 2.0)), SCREEN.panel(), RIG, background=(0, 0, 0))
    (near, plane), (near_right, plane_right) = columns(left), columns(right)
    assert plane == pytest.approx(plane_right, abs=0.02)
    geometry = eye_geometry(SCREEN.panel(), RIG)
    parallax = 80 * geometry["baseline"] * (1 / 1.5 - 1 / 2.0)
    assert near - near_right == pytest.approx(parallax, abs=0.05) and parallax > 2
    # Where a viewer's eyes are, in units of the screen: 63 mm at 600 mm before it
    assert geometry["baseline"] == pytest.approx(2.0 * 63 / SCREEN.distance_mm)


def test_layouts_have_the_left_eye_left_on_top_and_red():
    eyes = torch.stack([torch.full((4, 6, 3), 200, dtype=torch.uint8), torch.full((4, 6, 3), 40, dtype=torch.uint8)])
    wide, half, tall = (join_eyes(eyes, layout) for layout in ("sbs", "half-sbs", "tab"))
    assert wide.shape == (4, 12, 3) and half.shape == (4, 6, 3) and tall.shape == (8, 6, 3)
    for first, second in ((wide[:, :6], wide[:, 6:]), (half[:, :3], half[:, 3:]), (tall[:4], tall[4:])):
        assert first.unique().tolist() == [200] and second.unique().tolist() == [40]
    red, *cyan = join_eyes(eyes, "anaglyph")[0, 0].tolist()
    assert red > 190 and max(cyan) < 60


def test_a_wide_screen_far_away_strains_less_than_a_near_one():
    """The eyes' angles count, whatever their distance: twice of all lengths is the same screen."""
    small, large = StereoScreen(96, 54, 20.0, 60.0, 500.0), StereoScreen(96, 54, 40.0, 120.0, 1000.0)
    assert small.panel().to_dict() == pytest.approx(large.panel().to_dict())


@pytest.mark.parametrize(
    "name, kind, is_swapped",
    [
        ("film_LRF_Full_SBS.mp4", "sbs", False),
        ("a_2x1.png", "sbs", False),
        ("a_half_2x1.png", "half-sbs", False),
        ("a-HSBS.jpg", "half-sbs", False),
        ("a_RL_sbs.jpg", "sbs", True),
        ("a_TB.mp4", "tab", False),
        ("a half-ou.mkv", "half-tab", False),
        ("a_half_ou.mkv", "half-tab", False),
        ("a.jps", "sbs", True),
        ("Film.3D.Half-OU.1080p.mkv", "half-tab", False),
        ("Film 3D Full SBS 4k.mkv", "sbs", False),
        ("a [HSBS].mp4", "half-sbs", False),
        ("a_180_3dh.mp4", "sbs", False),
        ("a_SBS_RL.jpg", "sbs", True),
        ("a_crosseyed.jpg", "sbs", True),
        ("a_sbs_4k.mp4", "sbs", False),
        ("Show.SBS.S01E02.mkv", None, False),
        ("red_cross.jpg", None, False),
        ("stab.png", None, False),
        ("chat_ou_chien.jpg", None, False),
        ("photo.mpo", None, False),
    ],
)
def test_names_state_layouts(name, kind, is_swapped):
    found = layout_in_name(Path(name))
    assert (found and found.kind, bool(found and found.is_swapped)) == (kind, is_swapped)


def test_halves_of_unstated_size_are_squeezed_where_both_make_a_films_picture():
    for name, height, width, kind in (
        ("a_sbs.mp4", 1080, 1920, "half-sbs"),
        ("a_sbs.mp4", 1080, 3840, "sbs"),
        ("a_ou.mp4", 1080, 1920, "half-tab"),
        ("a_full_sbs.mp4", 1080, 1920, "sbs"),
        ("a_2x1.png", 1080, 1920, "sbs"),
    ):
        assert layout_in_name(Path(name)).resolved(height, width).kind == kind


def test_what_is_written_is_what_names_state():
    for layout in ("sbs", "half-sbs", "tab"):
        (path,) = stereo_paths(Path("a.png"), layout)
        assert layout_in_name(path).kind == layout and stereo_paths(path, layout) == (path,)
    assert [path.name for path in stereo_paths(Path("a.png"), "left-right")] == ["a_left.png", "a_right.png"]
    assert stereo_paths(Path("b_2x1"), "sbs") == (Path("b_2x1.png"),)


def test_encode_writes_pairs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    balls((-0.3, 0, 1.5), (0.3, 0, 2.0)).save("s.ply")
    for layout, name in (
        ("sbs", "a.png"),
        ("mpo", "a"),
        ("left-right", "a.tif"),
        ("anaglyph", "a.jpg"),
        ("sbs", "a.jps"),
    ):
        assert cli.main(["encode", "s.ply", "-o", name, "--stereo", layout, "--eye-size", "96x54"]) == 0
        out = capsys.readouterr().out
        assert "stereo: eyes 63 mm apart, 600 mm before a screen of 27 inches (assumed" in out and "comfort: " in out
    pair = read_image("a_LRF_Full_SBS.png", as_stored=True)
    assert pair.shape == (54, 192, 3)
    assert (pair[:, :96] == read_image("a_left.tif", as_stored=True)).all()
    assert (pair[:, 96:] == read_image("a_right.tif", as_stored=True)).all()
    assert count_pictures(Path("a.mpo")) == (2, True)
    with Image.open("a.mpo") as image:
        for eye in np.split(pair.astype(int), 2, 1):
            assert np.abs(np.asarray(image.convert("RGB")) - eye).mean() < 2
            image.seek(1)
    stored = [json.loads(read_info(name).metadata["stereo"]) for name in ("a.mpo", "a.jps", "a_LRF_Full_SBS.png")]
    assert len({json.dumps(one | {"layout": ""}) for one in stored}) == 1
    for line, words in (
        ("-o a.png --stereo mpo", "--stereo mpo goes into .mpo"),
        ("-o a.heic --stereo sbs", "pi-heif has no encoder"),
        ("-o a.png --stereo sbs --preview p", "--preview is about a panel"),
        ("-o a.png --eye-distance 60", "--eye-distance is for --stereo"),
    ):
        assert words in complaint(capsys, f"encode s.ply {line}")


def test_eyes_and_screen_are_asked_for_once(tmp_path, monkeypatch, capsys):
    """At a terminal; the answers hold from then on, and an option goes before them."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))
    monkeypatch.setenv("APPDATA", str(tmp_path / "settings"))
    monkeypatch.chdir(tmp_path)
    balls((-0.3, 0, 1.5), (0.3, 0, 2.0)).save("s.ply")
    line = "encode s.ply -o a.png --stereo tab --eye-size 96x54"

    def said(more: str = "") -> str:
        assert cli.main(f"{line}{more}".split()) == 0
        return capsys.readouterr().out

    assert "eyes 63 mm apart" in said() and not (tmp_path / "settings").exists()
    monkeypatch.setattr(sys, "stdin", io.StringIO("wide\n65\n\n"))
    monkeypatch.setattr("lightfield_gs.app.own_eyes.can_ask", lambda: True)
    assert "eyes 65 mm apart, 600 mm before a screen of 27 inches (as kept in" in said()
    assert "eyes 65 mm apart" in said()  # without a question, for nothing is left to read
    assert "eyes 60 mm apart" in said(" --eye-distance 60")


def test_videos_say_where_the_eyes_are(tmp_path, monkeypatch, capsys):
    """By the stream of H.264 and by Matroska; the program reads both again. An ordinary video says nothing."""
    pytest.importorskip("av", reason="videos need the extra `video`")
    from lightfield_gs.video.sequence import open_sequence

    monkeypatch.chdir(tmp_path)
    balls((-0.3, 0, 1.5), (0.3, 0, 2.0)).save("s.ply")
    for options, name, kind in (
        ("--stereo half-sbs --eye-size 96x54", "v_half_2x1.mp4", "sbs"),
        ("--stereo tab --eye-size 96x54", "v_LR_Full_TAB.mkv", "tab"),
        ("--preset hololuminescent", "v.mp4", None),
    ):
        end = Path(name).suffix
        assert cli.main(f"video s.ply -o v{end} --frames 2 {options}".split()) == 0
        pair = open_sequence(name).pair
        assert (pair and pair.kind) == kind and not (pair and pair.is_swapped)
    assert "two eyes" in capsys.readouterr().out
    assert cli.main("video s.ply -o f --frames 1 --preset hololuminescent".split()) == 0
    picture = read_image("f/frame-000000.png", as_stored=True)
    rows = np.flatnonzero((picture.min(2) < 250).any(1))
    assert picture.shape == (2160, 3840, 3) and rows[0] >= 0.09 * 2160 and rows[-1] <= 0.97 * 2160
    capsys.readouterr()
    assert "takes sbs, half-sbs, tab or anaglyph" in complaint(capsys, "video s.ply -o v.mp4 --stereo mpo")


def test_single_views_are_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    balls((-0.3, 0, 1.5), (0.3, 0, 2.0)).save("s.ply")
    assert cli.main("quilt s.ply -o views --sweep 5x1 --size 400x60".split()) == 0
    assert cli.main("quilt s.ply -o q.png --tiles 5x1 --size 400x60".split()) == 0
    (quilt,) = Path().glob("q_qs5x1*.png")
    views = [read_image(path, as_stored=True) for path in sorted(Path("views").iterdir())]
    assert (np.concatenate(views, 1) == read_image(quilt, as_stored=True)).all()
    capsys.readouterr()
    assert "the cameras stand in one row" in complaint(capsys, "quilt s.ply -o views --sweep 5x2")
