"""The front of scenes without cameras: a box of four walls, one of them with a picture on it."""

import math

import pytest
import torch
from command_line import run
from panel_cases import plain_panel

from lightfield_gs.io.images import read_image
from lightfield_gs.panels.front import find_front
from lightfield_gs.scene.gaussians import Gaussians

CELLS = 40  # of a wall, each way


def box(turn_deg: float, up: str = "-y") -> Gaussians:
    """Walls round a vertical axis, plain ones and one with a chequered picture, which a camera at turn_deg sees."""
    across, down = torch.meshgrid(*[(torch.arange(CELLS) + 0.5) / CELLS - 0.5] * 2, indexing="xy")
    walls, colours = [], []
    for side in (0, 90, 180, 270):
        angle = math.radians(turn_deg + side)
        # The camera of turn 0 stands at -z; one further to the right stands towards x
        out = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)])
        right = torch.tensor([math.cos(angle), 0.0, math.sin(angle)])
        walls.append(0.5 * out + across.reshape(-1, 1) * right + down.reshape(-1, 1) * torch.tensor([0.0, 1.0, 0.0]))
        generator = torch.Generator().manual_seed(side)
        picture = torch.rand(CELLS // 4, CELLS // 4, 3, generator=generator)
        picture = picture.repeat_interleave(4, 0).repeat_interleave(4, 1).reshape(-1, 3)
        colours.append(picture - 0.5 if side == 0 else torch.zeros(CELLS**2, 3) + 0.02 * side / 90)
    means = torch.cat(walls)
    if up == "z":  # y becomes -z, z becomes y
        means = torch.stack([means[:, 0], means[:, 2], -means[:, 1]], 1)
    count = len(means)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), 0.6 / CELLS),
        torch.full((count,), 0.98),
        torch.cat(colours)[:, None] / 0.2820948,
    )


@pytest.mark.parametrize("up", ["-y", "z"])
@pytest.mark.parametrize("turn", [0, 90, 180, -90])
def test_the_side_with_the_picture_is_the_front(turn, up):
    found = find_front(box(turn, up), up)
    assert math.cos(math.radians(found - turn)) > math.cos(math.radians(31))


def test_a_scene_opens_from_its_front_and_says_so(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plain_panel(96, 60).to_yaml("p.yaml")
    box(180).save("s.ply")
    words = run(capsys, "encode s.ply -o a.png --panel p.yaml --save-rig a.yaml")
    assert "front: turned by 180 degrees" in words and "--turn 0" in words
    assert "turned: 180" in run(capsys, "encode s.ply -o b.png --panel p.yaml --turn 180 --save-rig b.yaml")
    assert (tmp_path / "a.yaml").read_text() == (tmp_path / "b.yaml").read_text()
    assert "turned" not in run(capsys, "encode s.ply -o c.png --panel p.yaml --turn 0")


def test_a_pale_scene_stands_before_a_dark_background_unless_one_is_given(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plain_panel(96, 60).to_yaml("p.yaml")
    pale = box(0)
    pale.sh[:] = 0.48 / 0.2820948  # nearly white
    pale.save("s.ply")
    assert "background: dark, 0.12,0.12,0.12" in run(capsys, "encode s.ply -o a.png --panel p.yaml")
    corners = [read_image("a.png", as_stored=True)[0, 0].tolist()]
    assert "background" not in run(capsys, "encode s.ply -o b.png --panel p.yaml --background white")
    corners.append(read_image("b.png", as_stored=True)[0, 0].tolist())
    assert corners == [[31, 31, 31], [255, 255, 255]]
