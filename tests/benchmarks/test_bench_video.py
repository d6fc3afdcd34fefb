"""bench video: rows of frames that go nowhere and into files."""

import json

import pytest
from command_line import complaint

from lightfield_gs import cli


def test_rows_and_table(folder, capsys):
    line = "bench video --scene s.ply --files none,png --frames 3 --panel p.yaml --threads 1 --json rows.json"
    assert cli.main(line.split()) == 0
    rows = json.loads((folder / "rows.json").read_text())["rows"]
    assert [(row["sink"], row["frames"]) for row in rows] == [("none", 3), ("png", 3)]
    assert rows[0]["bytes_per_frame"] == 0 and rows[1]["bytes_per_frame"] > 100
    for row in rows:
        parts = sum(row[key] for key in ("scene_s", "draw_s", "wait_s", "finish_s"))
        assert parts == pytest.approx(row["total_s"]) and row["frames_per_second"] == pytest.approx(3 / row["total_s"])
    assert "frames/s" in capsys.readouterr().out


def test_files_of_no_kind(folder, capsys):
    assert "--files: expected some of none, png" in complaint(capsys, "bench video --scene s.ply --files gif")
