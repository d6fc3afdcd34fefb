"""bench live: the loop on a made clip, and what it says of it."""

import json

import pytest
from command_line import complaint, run

pytest.importorskip("av", reason="live sources need the extra `video`")


def test_a_row_says_how_fast_each_way_is_and_what_bounds_it(tmp_path, capsys):
    short = "--seconds 2 --warm-up 1 --pixels 20000 --network-px 28 --quality fast --threads 1"
    run(capsys, f"bench live --panel toy-8v --way depth {short} --json {tmp_path}/rows.json")
    (row,) = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert 0 < row["frames_per_second"] <= row["source_fps"] and 0 < row["latency_ms_median"] <= row["latency_ms_95"]
    assert row["bound"] in row["stages_ms"] and {"depth", "encode"} <= {*row["stages_ms"]}
    assert 20e6 < row["network_parameters"] < 30e6  # as Depth Anything Small
    assert row["memory_after"]["threads"] == row["memory_before"]["threads"]
    assert "expected some of object, depth" in complaint(capsys, "bench live --way page")
