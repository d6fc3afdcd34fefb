"""The benchmark of light fields: its rows, and how images are compared with the oracle and with one another."""

import itertools
import json

import numpy as np
import pytest
import torch
from bench_cases import arguments

from lightfield_gs.bench import light_field, scenes
from lightfield_gs.commands import bench as command
from lightfield_gs.panels.panel import Panel

KEYS = {
    "scene",
    "gaussians",
    "sh_degree",
    "panel",
    "cone",
    "cone_deg",
    "method",
    "device",
    "ms_median",
    "ms_min",
    "ms_max",
    "runs",
    "stages_ms",
    "kernel",
    "pairs",
    "evaluations_per_subpixel",
    "colour_error",
    "work_bytes",
    "memory_bytes",
    "memory_bytes_unchunked",
    "memory_budget",
    "peak_bytes",
    "psnr_db",
    "max_error_255",
    "share_over_1",
}
STAGES = {"plan", "project", "order", "bin", "composite"}


def test_errors_are_counted_in_steps_of_8_bits():
    zeros = np.zeros(4, np.int64)
    expected = scenes.OracleSamples(zeros, np.arange(4), zeros, np.array([10, 20, 30, 40]))
    image = torch.tensor([[[10, 0, 0], [21, 0, 0], [27, 0, 0], [40, 0, 0]]], dtype=torch.uint8)
    errors = expected.errors(image)
    assert errors["max_error_255"] == 3 and errors["share_over_1"] == 0.25
    assert errors["psnr_db"] == pytest.approx(10 * np.log10(255**2 * 4 / 10))


def test_images_are_compared_as_numbers_not_as_bytes():
    a, b = (torch.tensor(values, dtype=torch.uint8) for values in ([0, 255, 7, 9, 3], [255, 0, 7, 8, 5]))
    assert light_field.differences(a, b) == {"subpixels": 5, "max_difference_255": 255, "differing": 4, "over_1": 3}


def test_rows_have_the_keys_and_the_images_are_right(tmp_path, capsys):
    small = Panel(width_px=192, height_px=96, views=12, line_number=6.3, slant_tan=0.2, name="small")
    small.to_yaml(tmp_path / "small.yaml")
    code = command.run(
        arguments(
            "--scene",
            "sheet:24,cloud:500",
            "--panel",
            str(tmp_path / "small.yaml"),
            "--cone",
            "narrow,40",
            "--methods",
            "direct,classic",
            "--repeats",
            "2",
            "--sh-degree",
            "0,2",
            "--json",
            str(tmp_path / "rows.json"),
        )
    )
    assert code == 0
    result = json.loads((tmp_path / "rows.json").read_text())
    rows, comparisons = result["rows"], result["comparisons"]
    expected = itertools.product(("sheet:24", "cloud:500"), ("narrow", 40), (0, 2), ("direct", "classic"))
    assert [(row["scene"], row["cone"], row["sh_degree"], row["method"]) for row in rows] == list(expected)
    for row in rows:
        assert set(row) == KEYS
        assert row["gaussians"] == (576 if row["scene"] == "sheet:24" else 500) and row["panel"] == "small"
        assert row["cone_deg"] == (40 if row["cone"] == 40 else pytest.approx(2 * np.degrees(np.arctan(80 / 192))))
        assert STAGES <= set(row["stages_ms"])
        assert 0 < row["ms_min"] <= row["ms_median"] <= row["ms_max"] and row["runs"] == 2
        assert row["pairs"] > 0 and row["evaluations_per_subpixel"] > 0 and row["work_bytes"] > 0
        assert row["psnr_db"] >= 70 and row["max_error_255"] <= 2
    assert [(pair["scene"], pair["cone"], pair["sh_degree"]) for pair in comparisons] == [
        (row["scene"], row["cone"], row["sh_degree"]) for row in rows[::2]
    ]
    assert all(pair["subpixels"] == 192 * 96 * 3 and pair["max_difference_255"] <= 1 for pair in comparisons)
    assert [cost["sh_degrees"] for cost in result["harmonics"]] == [[0, 2]] * 8
    assert result["machine"]["torch"] == torch.__version__ and result["peers"] == {}
    shown = capsys.readouterr()
    assert "composite" in shown.out and "narrow (45.2)" in shown.out and "bench:" in shown.err
    assert "SH degree 2 takes" in shown.out and torch.__version__ in shown.out


def test_cost_of_harmonics_is_within_one_scene_cone_and_method():
    def row(cone, degree, ms, method="direct"):
        return {"scene": "sheet:4", "cone": cone, "method": method, "sh_degree": degree, "ms_median": ms}

    costs = light_field.harmonics_cost(
        [row(5, 3, 12.0), row(5, 0, 10.0), row(40, 0, 4.0), row(40, 1, 5.0), row(5, 3, 7.0, "classic")]
    )
    assert [(cost["cone"], cost["sh_degrees"], cost["times_as_long"]) for cost in costs] == [
        (5, [0, 3], 1.2),
        (40, [0, 1], 1.25),
    ]


def test_a_memory_budget_is_kept_by_sorted(tmp_path):
    small = Panel(width_px=192, height_px=96, views=12, line_number=6.3, slant_tan=0.2, name="small")
    small.to_yaml(tmp_path / "small.yaml")
    path = tmp_path / "rows.json"
    assert (
        command.run(
            arguments(
                "--scene",
                "sheet:24",
                "--panel",
                str(tmp_path / "small.yaml"),
                "--methods",
                "sorted,direct",
                "--repeats",
                "1",
                "--memory-budget",
                "0.5MB",
                "--json",
                str(path),
            )
        )
        == 0
    )
    ours, direct = json.loads(path.read_text())["rows"]
    assert ours["memory_budget"] == 500_000 and direct["memory_budget"] is None
    assert sum(ours["memory_bytes"].values()) <= 500_000 < sum(ours["memory_bytes_unchunked"].values())
