"""`bench training-step`: the rows of the times of training steps."""

import json

import torch
from bench_cases import arguments

from benchmarks import training_step
from lightfield_gs.bench import scenes
from lightfield_gs.bench.dense import OURS, Step
from lightfield_gs.commands import bench as command
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.gaussians import Gaussians


def test_training_step_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.training_step.OBJECTS", 1)
    monkeypatch.setattr("benchmarks.training_step.SIZE_PX", 16)
    path = tmp_path / "step.json"
    assert command.run(arguments("training-step", "--threads", "1,2", "--repeats", "1", "--json", str(path))) == 0
    rows = json.loads(path.read_text())["rows"]
    assert [row["threads"] for row in rows] == [1, 2]
    assert all(row["gaussians"] == 512 and 0 < row["ms_forward"] < row["ms_total"] for row in rows)


def test_a_training_step_gives_every_field_its_gradient():
    scene = scenes.sheet(8)
    scene = Gaussians(*(field[None].requires_grad_() for field in scene.fields().values()))
    step = Step(scene, lambda gaussians: render(gaussians, training_step.cameras()).image, torch.sum)
    row = training_step.step_row(step, False, 2)
    assert row["ms_total"] >= row["ms_forward"] > 0 and row["ms_backward"] > 0 and row["images"] == 4
    expected = torch.autograd.grad(render(scene, training_step.cameras()).image.sum(), list(scene.fields().values()))
    assert all(torch.equal(a.grad, b) for a, b in zip(scene.fields().values(), expected))


def test_training_step_names_how_many_times_as_fast_ours_is():
    row = {"device": "cuda", "card": "card", "objects": 32, "views": 4, "size_px": 128, "gaussians": 16384}
    shown = training_step.table(
        [
            row | {"program": OURS, "ms_forward": 1.0, "ms_backward": 1.5, "ms_total": 2.5},
            row | {"program": "gsplat 9", "ms_forward": 4.0, "ms_backward": 6.0, "ms_total": 10.0},
        ]
    ).splitlines()
    assert shown[1].startswith("gsplat 9: 32 objects") and "both 10.00 ms" in shown[1] and len(shown) == 3
    assert shown[2] == "ours is 4.0 times as fast as gsplat 9 forward + backward, 4.0 times forward"
