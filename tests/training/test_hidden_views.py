"""Scores of hidden surfaces beside a photograph: a square before a wall of one colour, seen by three cameras."""

import numpy as np
import pytest
import torch
from fit_capture import write_capture

from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.scene.gaussians import Gaussians
from training.hidden.evaluate import main
from training.hidden.views import ANGLES_DEG, SideViews

WALL = torch.tensor([0.3, 0.5, 0.7])


def plane(half: float, z: float, step: float) -> torch.Tensor:
    """Points of a square, so far before a camera."""
    side = torch.arange(-half, half + step / 2, step).double()
    across = torch.cartesian_prod(side, side)
    return torch.cat([across, torch.full((len(across), 1), z).double()], 1)


def scene(pose: np.ndarray) -> Gaussians:
    """A red square before the wall, in the axes of the capture."""
    parts = (plane(3.0, 4.0, 0.04), WALL, 0.03), (plane(0.35, 2.5, 0.02), torch.tensor([0.8, 0.1, 0.1]), 0.015)
    means = np.concatenate([(points.numpy() - pose[:3, 3]) @ pose[:3, :3] for points, _, _ in parts])
    colours = torch.cat([colour.expand(len(points), 3) for points, colour, _ in parts])
    scales = torch.cat([torch.full((len(points), 3), scale) for points, _, scale in parts])
    count = len(means)
    turns = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    harmonics = ((colours - 0.5) / SH_CONSTANT)[:, None].float()
    return Gaussians(torch.from_numpy(means).float(), turns, scales, torch.full((count,), 0.99), harmonics)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    root = tmp_path_factory.mktemp("views")
    folder = write_capture(root / "capture", 3)
    photographs = read_capture(folder)
    scene(photographs.world_to_camera[1]).save(root / "scene.ply")
    return folder, root / "scene.ply", photographs.names[1]


def test_the_true_colours_score_best(capture):
    photo = SideViews(*capture)
    scores = {
        name: photo.scores(photo.views(lambda image, depth, found, c=colour: (found, c.expand_as(image))))
        for name, colour in (("true", WALL), ("wrong", WALL + 0.2))
    }
    for deg in ANGLES_DEG:
        assert scores["true"][deg] > scores["wrong"][deg] + 4


def test_the_program_prints_a_row_for_each_angle(capture, capsys):
    assert main(["--capture", *map(str, capture)]) == 0
    rows = capsys.readouterr().out.splitlines()
    assert len(rows) == len(ANGLES_DEG) and all("membrane" in row and "exemplar" in row for row in rows)
    assert main(["--meshes", "nowhere"]) == 2 and "--photographs" in capsys.readouterr().err
