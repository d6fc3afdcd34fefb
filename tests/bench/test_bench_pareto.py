"""`bench pareto`: times and errors of many scenes and settings."""

import itertools
import json
from dataclasses import fields
from functools import partial

import pytest
from bench_cases import PANEL, arguments
from PIL import Image

from lightfield_gs.bench import pareto, photo, scenes
from lightfield_gs.commands import bench as command
from lightfield_gs.rasterizer.quality import EXACT, QUALITIES, Quality


def test_pareto_rows_table_and_plot(tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("lightfield_gs.bench.pareto.oracle_samples", partial(scenes.oracle_samples, count=500))
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
    assert {setting.quality for setting in pruned.values()} == {EXACT, Quality.of("fast"), *rough}
    assert len(pruned) == len(pareto.PRUNED) * (2 + len(pareto.CUTS)) and len(rough) == len(pareto.CUTS)
    assert {name.split()[0] for name in alone} == {field.name for field in fields(Quality)}
