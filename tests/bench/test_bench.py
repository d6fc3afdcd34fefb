"""The benchmark: its scenes, its rows, and what it refuses."""

import argparse
import itertools
import json
import time
from dataclasses import fields
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import light_field, oracle, paper, pareto, photo, scenes, timing, training
from lightfield_gs.cli import build_parser
from lightfield_gs.commands import bench as command
from lightfield_gs.panels.panel import Panel
from lightfield_gs.rasterizer.images import render
from lightfield_gs.rasterizer.quality import EXACT, QUALITIES, Quality
from lightfield_gs.scene.gaussians import Gaussians

PANEL = Panel(width_px=96, height_px=48, views=6, line_number=6.3, slant_tan=0.2)
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


def arguments(*words: str) -> argparse.Namespace:
    return build_parser("bench").parse_args(["bench", *words])


@pytest.mark.parametrize("kind, size, seed", [("sheet", 1, 0), ("sheet", 37, 5), ("cloud", 1, 0), ("cloud", 1234, 8)])
def test_scenes_are_those_of_other_programs_bit_for_bit(shared_dir, kind, size, seed, monkeypatch):
    import importlib.util

    monkeypatch.setattr("sys.dont_write_bytecode", True)
    spec = importlib.util.spec_from_file_location("other_bench_scenes", shared_dir / "bench_scenes.py")
    others = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(others)
    theirs, ours = getattr(others, kind)(size, seed), getattr(scenes, kind)(size, seed)
    for their_name, our_name in (
        ("means", "means"),
        ("quats", "quaternions"),
        ("scales", "scales"),
        ("opacities", "opacities"),
    ):
        np.testing.assert_array_equal(theirs[their_name], ours.fields()[our_name].numpy())
    colours = 0.5 + 0.28209479177387814 * ours.sh[:, 0].double().numpy()
    np.testing.assert_allclose(theirs["colors"], colours, atol=2e-7)
    assert others.ZERO_DEPTH == scenes.ZERO_DEPTH


@pytest.mark.parametrize(
    "name",
    [
        "sheet",
        "sheet:",
        "sheet:0",
        "sheet:-4",
        "sheet:1e3",
        "cloud:nan",
        "cube:4",
        "scene",
        "sheet:99999999999",
        "no-such.ply",
    ],
)
def test_unknown_scenes_are_named(name):
    with pytest.raises(InputError):
        scenes.load_scene(name)


def disparity_px(panel: Panel, cone: str | float, depth: float) -> float:
    """Between the two outermost views, of a point on the axis, by the cameras themselves."""
    rig = scenes.benchmark_rig("sheet:1", scenes.sheet(1), panel, cone)
    cameras = rig.cameras_at(panel, [0.0, float(panel.views)])
    point = cameras.world_to_camera @ torch.tensor([0.0, 0.0, depth, 1.0], dtype=torch.float64)
    x = cameras.focal_px[:, 0] * point[:, 0] / point[:, 2] + cameras.principal_point_px[:, 0]
    return float((x[1] - x[0]).abs())


@pytest.mark.parametrize("name", ["bench-8k-96v", "bench-4k-71v"])
def test_narrow_is_forty_pixels_and_wide_is_53_degrees(name):
    panel = Panel.load(name)
    assert (panel.line_number, panel.slant_tan) == (16.013, pytest.approx(np.tan(0.18), abs=1e-15))
    assert disparity_px(panel, "narrow", 0.8 * scenes.ZERO_DEPTH) == pytest.approx(40, abs=1e-9)
    assert disparity_px(panel, "narrow", scenes.ZERO_DEPTH) == pytest.approx(0, abs=1e-9)
    assert scenes.cone_degrees("wide", panel, panel.width_px) == 53
    assert scenes.cone_degrees(None, panel, 1.0) == panel.cone_deg


def test_narrow_on_8k_is_the_baseline_of_other_programs():
    panel = Panel.load("bench-8k-96v")
    rig = scenes.benchmark_rig("sheet:1", scenes.sheet(1), panel, "narrow")
    assert rig.half_width(panel) == pytest.approx(40 / 1920, rel=1e-12)
    wide = scenes.benchmark_rig("sheet:1", scenes.sheet(1), panel, "wide")
    assert wide.half_width(panel) == pytest.approx(0.997, abs=5e-4)


def test_harmonics_are_added_the_same_every_time():
    plain, *rich = (scenes.load_scene("cloud:5000", degree) for degree in (0, 1, 3, 3))
    assert [scene.sh_degree for scene in (plain, *rich)] == [0, 1, 3, 3]
    assert torch.equal(rich[1].sh, rich[2].sh) and torch.equal(rich[1].sh[:, :4], rich[0].sh)
    assert torch.equal(rich[1].sh[:, :1], plain.sh) and torch.equal(rich[1].means, plain.means)
    for first, last, deviation in ((1, 4, 0.15), (4, 9, 0.1), (9, 16, 0.05)):
        assert float(rich[1].sh[:, first:last].std()) == pytest.approx(deviation, rel=0.03)
    with pytest.raises(InputError, match="own SH degree"):
        scenes.load_scene("some.ply", 0)


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


def test_errors_are_counted_in_steps_of_8_bits():
    zeros = np.zeros(4, np.int64)
    expected = oracle.OracleSamples(zeros, np.arange(4), zeros, np.array([10, 20, 30, 40]))
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
    assert "Table 1" in shown and "Table 3" in shown and "not at hand" in shown
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
    memory = shown[-5]
    assert "9.0 -> 1.0" in memory and "20.0 -> 2.5" in memory and memory.split()[1] == "sorted"
    assert len(paper.SCENES) == len(set(paper.SCENES)) == 10


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
    step = training.Step(scene, lambda gaussians: render(gaussians, training.cameras()), torch.sum)
    row = step.row(False, 2)
    assert row["ms_total"] >= row["ms_forward"] > 0 and row["ms_backward"] > 0 and row["images"] == 4
    expected = torch.autograd.grad(render(scene, training.cameras()).sum(), list(scene.fields().values()))
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


@pytest.mark.parametrize(
    "words",
    [
        "pareto --methods direct",
        "pareto --plot rows.txt",
        "--plot rows.png",
        "pareto --photo none.png",
        "pareto --threads 1,2",
        "pareto --model default",
        "skips --threads 1,2",
        "skips --methods direct",
        "skips --photo a.png",
        "skips --plot rows.png",
        "--photo a.png",
        "--model default",
        "photo --photo none.png",
        "photo --model none",
        "photo --cone 5",
        "photo --scene sheet:4",
        "--methods direct,fast",
        "--cone broad",
        "--cone 5,0",
        "--cone narrow,",
        "--sh-degree 4",
        "--sh-degree 0,x",
        "--methods direct,gsplat-classic",
        "--methods=",
        "--cone 0",
        "--repeats 0",
        "--device gpu",
        "--threads x",
        "--panel no-such-panel",
        "--scene cube:4",
        "--memory-budget 1MB",
        "--memory-budget lots",
        "training-step --memory-budget 1MB",
        "training-step --scene sheet:4",
        "training-step --sh-degree 3",
        "--oracle-samples 0",
        "photo --oracle-samples 9",
        "--json /no/such/folder/rows.json",
        "--threads 1,2",
        "--scene sheet:8,no-such.ply",
        "--cone 5,200",
        "--cone 5,180",
        "--cone nan",
        "paper --scene sheet:8,cloud:x",
        "pareto --scene sheet:8,no-such.ply",
        "pareto --scene sheet:8 --cone 5,200",
        "skips --scene sheet:8,no-such.ply",
        "skips --scene sheet:8 --cone 5,200",
    ],
)
def test_bad_arguments_are_refused_before_any_work(words, monkeypatch):
    monkeypatch.setattr(scenes, "_MAKERS", {"sheet": None, "cloud": None})
    with pytest.raises(InputError) as error:
        command.run(arguments(*words.split()))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("what", ["pareto --scene sheet:8", "photo"])
def test_a_photo_without_a_cut_out_is_refused_before_any_work(what, tmp_path, monkeypatch):
    monkeypatch.setattr(scenes, "_MAKERS", {"sheet": None})
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (40, 40, 3), np.uint8)).save(tmp_path / "busy.png")
    with pytest.raises(InputError, match="--photo: .*busy.png has no cut-out"):
        command.run(arguments(*what.split(), "--photo", f"{photo.EXAMPLE},{tmp_path / 'busy.png'}"))
