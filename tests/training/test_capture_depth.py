"""The script that makes the depth map of a photograph of a fitted scene."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from fit_capture import write_capture

from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.photo.depth import read_depth, read_numbers
from lightfield_gs.scene.gaussians import Gaussians
from training.data.capture_depth import main

DEPTH = 2.5


def wall(pose: np.ndarray) -> Gaussians:
    """A wall across the view of a camera, at DEPTH before it, that ends in the middle of the picture."""
    across = torch.cartesian_prod(torch.linspace(-3, 0, 120), torch.linspace(-3, 3, 240)).double()
    seen = torch.cat([across, torch.full((len(across), 1), DEPTH).double()], 1).numpy()
    means = (seen - pose[:3, 3]) @ pose[:3, :3]
    count = len(means)
    return Gaussians(
        torch.from_numpy(means).float(),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), 0.02),
        torch.full((count,), 0.99),
        torch.zeros(count, 1, 3),
    )


def test_it_is_the_depth_of_what_the_photograph_shows(tmp_path, capsys):
    folder, out = write_capture(tmp_path / "capture", 3), tmp_path / "depth.npz"
    capture = read_capture(folder)
    wall(capture.world_to_camera[1]).save(tmp_path / "wall.ply")
    line = f"--capture {folder} --scene {tmp_path / 'wall.ply'} --name {capture.names[1]} --output {out}"
    assert main(line.split()) == 0
    numbers, z = read_numbers(out), read_depth(out)
    width, height = capture.sizes_px[1]
    assert z.shape == (height, width) and numbers.focal_px == pytest.approx(capture.intrinsics[1, 0])
    middle = int(capture.intrinsics[1, 2])
    assert z[:, : middle - 3] == pytest.approx(DEPTH, abs=0.02) and np.isnan(z[:, middle + 3 :]).all()

    capsys.readouterr()
    refused = {"--name other.png": "expected one of its photographs", f"--output {tmp_path / 'd.png'}": "ends in .npz"}
    for change, words in refused.items():
        assert main(f"{line} {change}".split()) == 2 and words in capsys.readouterr().err
    assert not (tmp_path / "d.png").exists()
