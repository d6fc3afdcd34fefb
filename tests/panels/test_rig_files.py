"""Rigs in files: the size that they are for, files beside scenes, and scenes seen from another side."""

import re
from dataclasses import replace

import numpy as np
import pytest
from command_line import PANEL, complaint, run, scene
from panel_cases import template_panel

from lightfield_gs import Rig, cli
from lightfield_gs.io.images import read_image, read_info
from lightfield_gs.io.text_files import parse_json
from lightfield_gs.panels.stored_rigs import read_rig_file

SIZE = (PANEL.width_px, PANEL.height_px)
WIDE = template_panel(288, 120, 12, phase=-3.5, cone_deg=30, viewing_distance_mm=600, pixel_pitch_mm=0.1, name="wide")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    PANEL.to_yaml("p.yaml")
    WIDE.to_yaml("wide.yaml")
    scene().save("s.ply")


def stored_rig(name="o.png") -> Rig:
    return Rig(**parse_json(read_info(name).metadata["rig"]))


def test_a_rig_of_another_panel_is_fitted_and_said(capsys):
    run(capsys, "encode s.ply -o o.png --panel p.yaml --save-rig r.yaml")
    assert read_rig_file("r.yaml").size_px == SIZE
    words = run(capsys, "encode s.ply -o o.png --panel wide.yaml --rig r.yaml")
    assert "r.yaml, fitted from 96 x 60 to the panel" in words
    own, wide = Rig.from_yaml("r.yaml"), stored_rig()
    assert wide.focal_px == pytest.approx([2 * f for f in own.focal_px])  # 60 becomes 120 px high
    expected = 144 + 2 * (own.principal_point_px[0] - 48), 2 * own.principal_point_px[1]
    assert wide.principal_point_px == pytest.approx(expected)
    assert Rig.from_yaml("r.yaml", WIDE).to_dict() == wide.to_dict()
    assert "96 x 60" in run(capsys, "info r.yaml")


def test_a_rig_of_another_panel_without_a_size_is_refused(capsys):
    run(capsys, "encode s.ply -o o.png --panel p.yaml --save-rig r.yaml")
    Rig.from_yaml("r.yaml").to_yaml("old.yaml")
    run(capsys, "encode s.ply -o o.png --panel p.yaml --rig old.yaml")
    wide = template_panel(960, 600, 12, name="large")
    wide.to_yaml("large.yaml")
    words = complaint(capsys, "encode s.ply -o o.png --panel large.yaml --rig old.yaml")
    assert "old.yaml: its principal point" in words and "size_px" in words
    with open("old.yaml", "a") as file:
        file.write("size_px: [96, 60]\n")
    assert "fitted" in run(capsys, "encode s.ply -o o.png --panel large.yaml --rig old.yaml")


@pytest.mark.parametrize("suffix", ["spz", "splat"])
def test_framing_and_background_are_kept_beside_a_scene(capsys, suffix):
    words = run(capsys, f"encode s.ply -o a.png --panel p.yaml --up y --background 0,0,1 --save-gaussians s.{suffix}")
    assert "framing and background in s.rig.yaml" in words
    words = run(capsys, f"encode s.{suffix} -o b.png --panel p.yaml")
    assert "the framing in s.rig.yaml" in words and "background: 0,0,1, as s.rig.yaml says" in words
    assert stored_rig("a.png").to_dict() == stored_rig("b.png").to_dict()
    difference = np.abs(read_image("a.png").astype(float) - read_image("b.png").astype(float))
    assert difference.mean() < 0.05 and (difference[0, 0] == 0).all()  # these formats round
    words = run(capsys, f"prune s.{suffix} -o less.spz --panel p.yaml --contribution-cut 0.001")
    assert "less.rig.yaml" in words and read_rig_file("less.rig.yaml").background == (0, 0, 1)


def test_a_scene_is_turned(capsys):
    run(capsys, "encode s.ply -o a.png --panel p.yaml --save-rig a.yaml")
    words = run(capsys, "encode s.ply -o b.png --panel p.yaml --turn 90 --tilt -20 --save-rig b.yaml")
    assert "turned: 90 degrees to the right, -20 up" in words
    a, b = (Rig.from_yaml(name).world_to_camera for name in ("a.yaml", "b.yaml"))
    forward = b[2, :3] @ a[:3, :3].T  # in the axes of the first camera
    angle = np.radians(20)
    assert forward == pytest.approx([-np.cos(angle), -np.sin(angle), 0], abs=1e-6)  # from the right, and from below
    centre = -b[:3, :3].T @ b[:3, 3]
    assert (a[:3, :3] @ centre + a[:3, 3])[0] > 0
    run(capsys, "encode s.ply -o c.png --panel p.yaml --rig a.yaml --turn 90 --save-rig c.yaml")
    assert Rig.from_yaml("c.yaml").focal_px == Rig.from_yaml("a.yaml").focal_px
    open("x.png", "w").close()
    assert "--turn is for files of Gaussians" in complaint(capsys, "encode x.png -o c.png --panel p.yaml --turn 9")


def test_a_wide_cone_is_said_with_a_narrower_one(capsys):
    wide = replace(PANEL, cone_deg=54, name="wide")
    replace(wide, width_px=960, height_px=600, pixel_pitch_mm=0.03).to_yaml("wide.yaml")
    rig = Rig(np.eye(4), (960.0, 960.0), (480.0, 300.0), 2.0)
    rig.world_to_camera[2, 3] = 2.0
    rig.to_yaml("r.yaml")
    words = run(capsys, "encode s.ply -o o.png --panel wide.yaml --rig r.yaml")
    line = next(line for line in words.splitlines() if line.startswith("cone: "))
    told = [float(number) for number in re.findall(r"([0-9.]+) px", line)]
    assert told[0] > 5 and told[1] == pytest.approx(told[0] * 0.6188, abs=0.1)  # tan 17.5 / tan 27
    assert "--cone 35" in line
    assert cli.main("encode s.ply -o o.png --panel wide.yaml --rig r.yaml --cone 35".split()) == 0
    assert "cone: " not in capsys.readouterr().out
    replace(rig, cone_deg=54.0).to_yaml("wide-rig.yaml")
    pair = "encode s.ply -o o.png --stereo sbs --rig wide-rig.yaml --eye-size 960x600 --depth-amount 1"
    assert cli.main(pair.split()) == 0
    assert "cone: " not in capsys.readouterr().out  # both eyes' pictures have no neighbours
