"""The benchmark: its scenes, its rows, and what it refuses."""

import argparse
import itertools
import json

import numpy as np
import pytest
import torch

from lightfield_gs import bench, bench_scenes
from lightfield_gs.errors import InputError
from lightfield_gs.panel import Panel

KEYS = {"scene", "gaussians", "panel", "cone_deg", "method", "device", "ms_median", "ms_min", "ms_max", "stages_ms",
        "pairs", "evaluations_per_subpixel", "work_bytes", "psnr_db", "max_error_255", "share_over_1"}
STAGES = {"plan", "project", "order", "bin", "composite"}


def arguments(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    return parser.parse_args(words)


@pytest.mark.parametrize("kind, size, seed", [("sheet", 1, 0), ("sheet", 37, 5), ("cloud", 1, 0), ("cloud", 1234, 8)])
def test_scenes_are_those_of_other_programs_bit_for_bit(shared_dir, kind, size, seed, monkeypatch):
    import importlib.util

    monkeypatch.setattr("sys.dont_write_bytecode", True)
    spec = importlib.util.spec_from_file_location("other_bench_scenes", shared_dir / "bench_scenes.py")
    others = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(others)
    theirs, ours = getattr(others, kind)(size, seed), getattr(bench_scenes, kind)(size, seed)
    for their_name, our_name in (("means", "means"), ("quats", "quaternions"), ("scales", "scales"),
                                 ("opacities", "opacities")):
        np.testing.assert_array_equal(theirs[their_name], ours.fields()[our_name].numpy())
    colours = 0.5 + 0.28209479177387814 * ours.sh[:, 0].double().numpy()
    np.testing.assert_allclose(theirs["colors"], colours, atol=2e-7)
    assert others.ZERO_DEPTH == bench_scenes.ZERO_DEPTH


@pytest.mark.parametrize("name", ["sheet", "sheet:", "sheet:0", "sheet:-4", "sheet:1e3", "cloud:nan", "cube:4", "scene",
                                  "sheet:99999999999", "no-such.ply"])
def test_unknown_scenes_are_named(name):
    with pytest.raises(InputError):
        bench_scenes.load_scene(name)


def test_errors_are_counted_in_steps_of_8_bits():
    zeros = np.zeros(4, np.int64)
    oracle = bench.OracleSamples(zeros, np.arange(4), zeros, np.array([10, 20, 30, 40]))
    image = torch.tensor([[[10, 0, 0], [21, 0, 0], [27, 0, 0], [40, 0, 0]]], dtype=torch.uint8)
    errors = oracle.errors(image)
    assert errors["max_error_255"] == 3 and errors["share_over_1"] == 0.25
    assert errors["psnr_db"] == pytest.approx(10 * np.log10(255**2 * 4 / 10))


def test_images_are_compared_as_numbers_not_as_bytes():
    a, b = (torch.tensor(values, dtype=torch.uint8) for values in ([0, 255, 7, 9, 3], [255, 0, 7, 8, 5]))
    assert bench.differences(a, b) == {"subpixels": 5, "max_difference_255": 255, "differing": 4, "over_1": 3}


def test_rows_have_the_keys_and_the_images_are_right(tmp_path, capsys):
    small = Panel(width_px=192, height_px=96, views=12, line_number=6.3, slant_tan=0.2, name="small")
    small.to_yaml(tmp_path / "small.yaml")
    code = bench.run(arguments("--scene", "sheet:24,cloud:500", "--panel", str(tmp_path / "small.yaml"), "--cone",
                               "5,40", "--methods", "direct,classic", "--repeats", "2",
                               "--json", str(tmp_path / "rows.json")))
    assert code == 0
    result = json.loads((tmp_path / "rows.json").read_text())
    rows, comparisons = result["rows"], result["comparisons"]
    expected = itertools.product(("sheet:24", "cloud:500"), (5, 40), ("direct", "classic"))
    assert [(row["scene"], row["cone_deg"], row["method"]) for row in rows] == list(expected)
    for row in rows:
        assert set(row) == KEYS
        assert row["gaussians"] == (576 if row["scene"] == "sheet:24" else 500) and row["panel"] == "small"
        assert STAGES <= set(row["stages_ms"])
        assert 0 < row["ms_min"] <= row["ms_median"] <= row["ms_max"]
        assert row["pairs"] > 0 and row["evaluations_per_subpixel"] > 0 and row["work_bytes"] > 0
        assert row["psnr_db"] >= 70 and row["max_error_255"] <= 2
    assert [(pair["scene"], pair["cone_deg"]) for pair in comparisons] == [
        (row["scene"], row["cone_deg"]) for row in rows[::2]]
    assert all(pair["subpixels"] == 192 * 96 * 3 and pair["max_difference_255"] <= 1 for pair in comparisons)
    shown = capsys.readouterr()
    assert "composite" in shown.out and "sheet:24" in shown.out and "bench:" in shown.err


def test_training_step_rows(tmp_path, monkeypatch):
    monkeypatch.setattr("lightfield_gs.bench_training.OBJECTS", 1)
    monkeypatch.setattr("lightfield_gs.bench_training.SIZE_PX", 16)
    path = tmp_path / "step.json"
    assert bench.run(arguments("training-step", "--threads", "1,2", "--repeats", "1", "--json", str(path))) == 0
    rows = json.loads(path.read_text())["rows"]
    assert [row["threads"] for row in rows] == [1, 2]
    assert all(row["gaussians"] == 512 and row["ms_forward"] > 0 and row["ms_backward"] > 0 for row in rows)


@pytest.mark.parametrize("words", ["--methods direct,fast", "--cone wide", "--cone 0", "--repeats 0", "--device gpu",
                                   "--threads x", "--panel no-such-panel", "--scene cube:4",
                                   "--json /no/such/folder/rows.json", "--threads 1,2"])
def test_bad_arguments_are_refused_before_any_work(words):
    with pytest.raises(InputError) as error:
        bench.run(arguments(*words.split()))
    assert "\n" not in str(error.value)
