"""How calls are timed, and the rows of the times of training steps and of photos."""

import itertools
import json
import time

import torch
from bench_cases import PANEL, arguments

from lightfield_gs.bench import scenes, timing, training
from lightfield_gs.commands import bench as command
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.gaussians import Gaussians


def test_runs_are_counted_and_kept_in_their_order(monkeypatch):
    calls = itertools.count()
    result, times = timing.timed(lambda: next(calls), False, 3)
    assert result == 2 and len(times) == 3 and min(times) > 0
    monkeypatch.setattr(timing, "SECONDS_PER_CALL", 0.0)
    assert len(timing.timed(lambda: None, False, 3)[1]) == 1


def test_short_calls_on_a_gpu_are_repeated_more_often(monkeypatch):
    took = iter([90.0] + [2.0] * 5 + [1.0] * 20 + [900.0, 400.0] + [400.0] * 5)  # 100 ms, then two calls, warm up
    monkeypatch.setattr(timing, "_cuda_ms", lambda calls, ahead: (calls[0](), (next(took),)))
    assert timing.timed(lambda: "image", True) == ("image", [1.0] * 20)
    assert timing.timed(lambda: "image", True) == ("image", [400.0] * 5)
    assert next(took, None) is None


def test_calls_in_turn_are_timed_one_by_one():
    order = []
    result, times = timing.timed_in_turn([lambda: order.append("a"), lambda: time.sleep(0.02)], False, 2)
    assert order == ["a", "a"] and result is None and len(times) == 2
    assert all(first < 10 <= 20 <= second for first, second in times)


def test_machine_is_described():
    found = timing.machine("cpu")
    assert found["torch"] == torch.__version__ and found["cores"] >= 1 and found["processor"] and "gpu" not in found


def test_training_step_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("lightfield_gs.bench.training.OBJECTS", 1)
    monkeypatch.setattr("lightfield_gs.bench.training.SIZE_PX", 16)
    path = tmp_path / "step.json"
    assert command.run(arguments("training-step", "--threads", "1,2", "--repeats", "1", "--json", str(path))) == 0
    rows = json.loads(path.read_text())["rows"]
    assert [row["threads"] for row in rows] == [1, 2]
    assert all(row["gaussians"] == 512 and 0 < row["ms_forward"] < row["ms_total"] for row in rows)


def test_a_training_step_gives_every_field_its_gradient():
    scene = scenes.sheet(8)
    scene = Gaussians(*(field[None].requires_grad_() for field in scene.fields().values()))
    step = training.Step(scene, lambda gaussians: render(gaussians, training.cameras()).image, torch.sum)
    row = step.row(False, 2)
    assert row["ms_total"] >= row["ms_forward"] > 0 and row["ms_backward"] > 0 and row["images"] == 4
    expected = torch.autograd.grad(render(scene, training.cameras()).image.sum(), list(scene.fields().values()))
    assert all(torch.equal(a.grad, b) for a, b in zip(scene.fields().values(), expected))


def test_training_step_names_how_many_times_as_fast_ours_is():
    row = {"device": "cuda", "card": "card", "objects": 32, "views": 4, "size_px": 128, "gaussians": 16384}
    shown = training.table(
        [
            row | {"program": training.OURS, "ms_forward": 1.0, "ms_backward": 1.5, "ms_total": 2.5},
            row | {"program": "gsplat 9", "ms_forward": 4.0, "ms_backward": 6.0, "ms_total": 10.0},
        ]
    ).splitlines()
    assert shown[1].startswith("gsplat 9: 32 objects") and "both 10.00 ms" in shown[1] and len(shown) == 3
    assert shown[2] == "ours is 4.0 times as fast as gsplat 9 forward + backward, 4.0 times forward"


def test_photo_rows(tmp_path, capsys):
    PANEL.to_yaml(tmp_path / "small.yaml")
    path = tmp_path / "photo.json"
    assert (
        command.run(
            arguments(
                "photo",
                "--panel",
                str(tmp_path / "small.yaml"),
                "--threads",
                "1,2",
                "--model",
                "small",
                "--repeats",
                "1",
                "--json",
                str(path),
            )
        )
        == 0
    )
    rows = json.loads(path.read_text())["rows"]
    assert [row["threads"] for row in rows] == [1, 2] and rows[0]["model"] == "small"
    for row in rows:
        assert list(row["stages_ms"]) == ["crop", "network", "framing", "encode"]
        assert min(row["stages_ms"].values()) > 0 and row["decode_ms"] > 0
        assert row["ms_min"] <= row["ms_median"] <= row["ms_max"] and row["gaussians"] > 1000
    shown = capsys.readouterr().out
    assert "total ms" in shown and len([line for line in shown.splitlines() if "cat.png" in line]) == 2
