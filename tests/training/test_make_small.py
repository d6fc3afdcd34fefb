"""The small set that is made by one command, and the configurations that take it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from lightfield_gs.base.errors import InputError
from training.compare import read_experiment
from training.comparison import azimuths_from_source
from training.data.images import read_view
from training.data.make_small import FOCAL_PX, SIZE_PX, main, make_small
from training.data.objects import MAKE_SMALL, find_objects, read_object
from training.data.validate import problems
from training.train import read_config

CONFIGS = Path(__file__).resolve().parents[2] / "configs/training"


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    """A set of one object to train on and one to score."""
    folder = tmp_path_factory.mktemp("small") / "set"
    make_small(folder, 1, 1)
    return folder


def test_objects_are_where_their_cameras_see_them(small):
    """The part of space that no view shows to be empty has the outlines of all views: poses belong to the pictures."""
    assert list(problems(find_objects(small))) == []
    cone, sphere = (read_object(small / name / "object-00") for name in ("train_cone", "train_sphere"))
    np.testing.assert_array_equal(read_view(cone, 0), read_view(sphere, 0))
    steps = np.linspace(-0.5, 0.5, 80)
    points = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    points = points[np.linalg.norm(points, axis=1) < 0.5]
    seen = []
    for views in (cone, sphere):
        for index, pose in enumerate(views.camera_to_world):
            x, y, z = ((points - pose[:3, 3]) @ pose[:3, :3]).T
            pixels = (np.stack([y, x]) / z * FOCAL_PX + SIZE_PX / 2).astype(int)
            seen.append((read_view(views, index)[..., 3] > 100, tuple(pixels)))
    solid = np.all([mask[places] for mask, places in seen], 0)
    for mask, places in seen:
        outline = np.zeros_like(mask)
        outline[tuple(place[solid] for place in places)] = True
        grown = outline.copy()
        for step, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
            grown |= np.roll(outline, step, axis)
        assert grown[mask].mean() > 0.97


def test_angles_are_those_that_training_and_scores_expect(small):
    cone, sphere, val = (read_object(next((small / name).iterdir())) for name in ("train_cone", "train_sphere", "val"))
    azimuths = azimuths_from_source(val.camera_to_world)
    np.testing.assert_allclose(sorted(azimuths), (-20, -15, -10, -5, 0, 5, 10, 15, 20), atol=1e-4)
    assert 20 < np.abs(azimuths_from_source(cone.camera_to_world)).max() < 33
    assert np.abs(azimuths_from_source(sphere.camera_to_world)).max() > 140


def test_the_same_set_every_time(small, tmp_path, capsys):
    assert main(["--output", str(tmp_path / "again"), "--objects", "1"]) == 0
    files = [sorted(path.relative_to(root) for path in root.rglob("*")) for root in (small, tmp_path / "again")]
    assert files[0] == files[1] and len(files[0]) > 60
    assert all(
        (small / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
        for name in files[0]
        if (small / name).is_file()
    )
    assert sum((small / name).stat().st_size for name in files[0] if (small / name).is_file()) < 300_000
    assert main(["--output", str(tmp_path / "again")]) == 2
    assert "exists: remove it" in capsys.readouterr().err
    assert main(["--output", str(small / "val/object-01/intrinsics.txt/x")]) == 2


def test_nothing_is_left_of_a_set_that_cannot_be_finished(tmp_path, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise InputError("full")

    monkeypatch.setattr(
        "training.data.make_small.draw_frames",
        lambda plan, _: torch.zeros(1, plan.world_to_camera.shape[1], 4, SIZE_PX, SIZE_PX),
    )
    monkeypatch.setattr("training.data.make_small.write_image", fail)
    with pytest.raises(InputError, match="full"):
        make_small(tmp_path / "set", 1, 1)
    assert not any(tmp_path.iterdir())


def test_configurations_take_the_folders_that_the_command_makes(small, capsys):
    made = {f"data/small/{path.name}" for path in small.iterdir()}
    run = read_config(["--config", str(CONFIGS / "cpu.yaml")])
    assert {*run.data, run.validation} <= made
    experiment, _ = read_experiment(["--config", str(CONFIGS / "compare-small.yaml")])
    folders = {objects.folder for objects in experiment.scored.values()}
    for arm in experiment.runs.values():
        folders |= {*arm.data, *arm.target_data, arm.validation}
    assert folders <= made and "data/small/train_sphere" in folders
    for name in ("cpu.yaml", "compare-small.yaml"):
        text = (CONFIGS / name).read_text()
        assert MAKE_SMALL in text and yaml.safe_load(text)
    with pytest.raises(InputError, match="no such folder.*python -m training.data.make_small --output data/small"):
        find_objects(small / "nothing")
