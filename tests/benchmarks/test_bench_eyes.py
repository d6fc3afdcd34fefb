"""`lightfield-gs bench eyes`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from benchmarks import eyes
from lightfield_gs import Panel, cli


def test_a_row_for_every_width_of_the_filter(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(eyes, "EYES", 5)
    panel = replace(Panel.load("toy-8v"), width_px=64, height_px=32, views=16)
    panel.to_yaml("p.yaml")
    assert eyes.filter_widths(panel) == [0, 0.5, 1, 1.58]
    assert cli.main("bench eyes --scene sheet:12 --panel p.yaml --json rows.json".split()) == 0
    shown = capsys.readouterr().out
    rows = json.loads(Path("rows.json").read_text())["rows"]
    assert [row["view_filter"] for row in rows] == [0, 0.5, 1, 1.58]
    for row in rows:
        each = [score["psnr_db"] for score in row["scores"]]
        assert len(each) == row["eyes"] == 5 and row["psnr_db_worst"] == min(each) <= row["psnr_db"] <= max(each)
        assert f"{row['psnr_db']:.2f}" in shown


def test_a_panel_before_which_no_eye_can_be_placed_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    replace(Panel.load("toy-8v"), viewing_distance_mm=None).to_yaml("p.yaml")
    assert cli.main("bench eyes --panel p.yaml".split()) == 2
    assert "lacks viewing_distance_mm" in capsys.readouterr().err
