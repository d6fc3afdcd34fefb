"""The scenes and cones of the benchmarks, and what is refused before any scene is made."""

import numpy as np
import pytest
import torch
from bench_cases import arguments
from PIL import Image

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import photo, scenes
from lightfield_gs.commands import bench as command
from lightfield_gs.panels.panel import Panel


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
    with pytest.raises(InputError, match="photo=: .*busy.png has no cut-out"):
        command.run(arguments(*what.split(), "--photo", f"{photo.EXAMPLE},{tmp_path / 'busy.png'}"))
