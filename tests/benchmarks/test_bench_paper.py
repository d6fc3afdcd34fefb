"""`bench paper`: tables of many scenes and methods."""

import itertools
import json

from bench_cases import PANEL, arguments

from benchmarks import paper
from lightfield_gs.commands import bench as command


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
