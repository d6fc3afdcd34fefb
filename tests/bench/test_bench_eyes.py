"""`lightfield-gs bench eyes`."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from lightfield_gs import Panel, cli
from lightfield_gs.bench import eyes


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


@pytest.mark.parametrize(
    ("change", "words"), [({"viewing_distance_mm": None}, "lacks viewing_distance_mm"), ({}, "--plot is for")]
)
def test_what_makes_no_sense_is_refused(tmp_path, monkeypatch, capsys, change, words):
    monkeypatch.chdir(tmp_path)
    replace(Panel.load("toy-8v"), **change).to_yaml("p.yaml")
    plot = "" if change else "--plot p.png"
    assert cli.main(f"bench eyes --panel p.yaml {plot}".split()) == 2
    assert words in capsys.readouterr().err
