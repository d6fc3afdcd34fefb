"""`bench paper` and `bench pareto`: tables of many scenes, methods and settings."""

import itertools
import json
from dataclasses import fields
from functools import partial

import pytest
from bench_cases import PANEL, arguments
from PIL import Image

from lightfield_gs.bench import oracle, paper, pareto, photo
from lightfield_gs.commands import bench as command
from lightfield_gs.rasterizer.quality import EXACT, QUALITIES, Quality


def test_paper_prints_a_line_for_each_scene_and_keeps_the_numbers(tmp_path, capsys):
    PANEL.to_yaml(tmp_path / "small.yaml")
    path = tmp_path / "paper.json"
    assert (
        command.run(
            arguments(
                "paper",
                "--scene",
                "sheet:8,cloud:100",
                "--panel",
                str(tmp_path / "small.yaml"),
                "--repeats",
                "1",
                "--json",
                str(path),
            )
        )
        == 0
    )
    rows = json.loads(path.read_text())["rows"]
    expected = itertools.product(("sheet:8", "cloud:100"), ("classic", "sorted", "direct"))
    assert [(row["scene"], row["method"]) for row in rows] == list(expected)
    shown = capsys.readouterr().out
    assert "Table 1" in shown and "Table 3" in shown and "RTX 3090" in shown
    assert len([line for line in shown.splitlines() if line.split()[:2] == ["sheet:8", "64"]]) == 1


def test_paper_tables_hold_ratios_and_memory():
    def row(method, ms, memory=None, unchunked=None):
        return {
            "scene": "sheet:8",
            "gaussians": 64,
            "cone": "panel",
            "cone_deg": 40.0,
            "sh_degree": 0,
            "ms_median": ms,
            "method": method,
            "work_bytes": 3_000_000,
            "memory_bytes": memory,
            "memory_bytes_unchunked": unchunked,
        }

    shown = paper.tables(
        [
            row("classic", 100.0),
            row("direct", 5.0),
            row(
                "sorted",
                40.0,
                {"geometry": 1_000_000, "image": 0, "binning": 2_500_000},
                {"geometry": 9_000_000, "image": 0, "binning": 20_000_000},
            ),
        ]
    ).splitlines()
    times = shown[2].split()
    assert times[:8] == ["sheet:8", "64", "40", "100", "5.000", "40.00", "20.0", "2.5"]
    # The paper's ten images by its two methods, their means (1.3101 and .0416 s), and its memory
    (mean,) = [line.split() for line in shown if line.split()[:2] == ["paper", "mean"]]
    assert mean[4:] == ["1310", "-", "41.60", "-", "31.5"] and sum("paper" in line.split() for line in shown) == 12
    memory = next(line for line in shown if "sorted" in line.split() and line.split()[0] == "sheet:8")
    assert "9.0 -> 1.0" in memory and "20.0 -> 2.5" in memory and memory.split()[1] == "sorted"
    assert len(paper.SCENES) == len(set(paper.SCENES)) == 10


def test_pareto_rows_table_and_plot(tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("lightfield_gs.bench.pareto.oracle_samples", partial(oracle.oracle_samples, count=500))
    PANEL.to_yaml(tmp_path / "small.yaml")
    path, picture = tmp_path / "pareto.json", tmp_path / "pareto.png"
    assert (
        command.run(
            arguments(
                "pareto",
                "--scene",
                "sheet:16,cloud:100",
                "--photo",
                str(photo.EXAMPLE),
                "--cone",
                "40",
                "--panel",
                str(tmp_path / "small.yaml"),
                "--repeats",
                "1",
                "--threads",
                "1",
                "--json",
                str(path),
                "--plot",
                str(picture),
            )
        )
        == 0
    )
    rows, chosen = json.loads(path.read_text())["rows"], list(pareto.settings())
    assert [(row["scene"], row["setting"]) for row in rows] == list(
        itertools.product(("sheet:16", "cloud:100", photo.EXAMPLE.name), chosen)
    )
    assert chosen[0] == "exact" and {row["setting"] for row in rows if row["named"]} == set(QUALITIES)
    for first in rows[:: len(chosen)]:
        assert first["times_as_fast"] == 1 and first["psnr_db"] >= 70 and first["max_error_255"] <= 2
    assert all(row["times_as_fast"] > 0 and row["psnr_db"] > 10 and row["runs"] == 1 for row in rows)
    with Image.open(picture) as shown:
        assert min(shown.size) > 200 and len(set(shown.convert("L").tobytes())) > 20
    shown = capsys.readouterr().out
    assert "times as fast" in shown and len([line for line in shown.splitlines() if "cloud:100" in line]) == len(chosen)


def test_pareto_front_is_what_nothing_beats():
    def row(ms, psnr_db):
        return {"ms": ms, "psnr_db": psnr_db}

    some = [row(9, 80), row(5, 50), row(6, 45), row(5, 49), row(2, 50), row(9, 80)]
    assert [row for row in some if pareto.on_front(row, some)] == [row(9, 80), row(2, 50), row(9, 80)]


def test_every_knob_stands_alone_and_is_left_out_once():
    chosen = pareto.settings()
    alone = [
        name
        for name, (quality, _) in chosen.items()
        if sum(getattr(quality, knob) != getattr(EXACT, knob) for knob in pareto.KNOBS) == 1
    ]
    pruned = {name: setting for name, setting in chosen.items() if setting.pruned}
    rough = {
        quality for quality, _ in chosen.values() if quality.opacity_cut in pareto.CUTS and not quality.lattice_error
    }
    assert {setting.quality for setting in pruned.values()} == {EXACT, QUALITIES["fast"], *rough}
    assert len(pruned) == len(pareto.PRUNED) * (2 + len(pareto.CUTS)) and len(rough) == len(pareto.CUTS)
    assert {name.split()[0] for name in alone} == {field.name for field in fields(Quality)}
