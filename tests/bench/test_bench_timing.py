"""How calls are timed, and the rows of the times of photos."""

import itertools
import json
import time

import torch
from bench_cases import PANEL, arguments

from lightfield_gs.bench import timing
from lightfield_gs.commands import bench as command


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
