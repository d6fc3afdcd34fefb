"""The comparison of arms: equal sources, the whole command, resuming, and its report."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from PIL import Image
from srn_scene import look_at, write_object
from training_runs import losses, run_config

from lightfield_gs import InputError
from lightfield_gs.io.text_files import config_path
from lightfield_gs.models import ModelConfig
from training import compare, compare_report, compare_trend, loop
from training.compare import read_experiment
from training.config import Stage, TrainingConfig
from training.data.batches import make_batch
from training.data.plan import Augmentation
from training.data.sampler import has_neighbour
from training.distributed import Team
from training.loop import make_planner

CONE = ((0, 0), (-8, 0), (8, 0), (22, 3), (29, 3), (-29, -4))
SPHERE = ((100, 20), (190, -30), (260, 50), (30, 0))
SPHERE_ARM = {"target_data": ["sphere"], "cone_deg": 360.0, "cone_margin": 1.0, "elevation_deg": 90.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three objects from views in a cone, in set/, and all round, in sphere/; two to be scored on, in val/."""
    folder = tmp_path_factory.mktemp("compare")
    for index in range(3):
        write_object(folder / f"set/object-{index}", angles=CONE, seed=index)
        write_object(folder / f"sphere/object-{index}", angles=SPHERE, seed=index)
    write_object(folder / "sphere/one-more", angles=SPHERE)
    for index in (7, 8):
        write_object(folder / f"val/object-{index}", angles=((0, 0), (5, 0), (-10, 0)), seed=index)
    threads = torch.get_num_threads()
    yield folder
    torch.set_num_threads(threads)


def arguments(folder, name="runs", **changes) -> list[str]:
    """Arguments of a comparison that takes seconds."""
    config = run_config(
        folder,
        name,
        **{
            "data": ["set"],
            "data_root": str(folder),
            "neighbour_deg": 10.0,
            "scored": {"near": "val"},
            "stages": [{"steps": 4, "image_size_px": 16, "objects": 2}],
            "checkpoint_every": 2,
            "threads": 1,
            "arms": {"constrained": {}, "sphere": SPHERE_ARM, "cone_10": {"cone_margin": 0.5}},
            "validation": "val",
            "validate_every": 2,
            "validation_objects": 1,
        }
        | changes,
    )
    return ["--config", str(config)]


def test_arms_differ_in_their_targets_only(folder):
    experiment, _ = read_experiment(arguments(folder))
    planners = [make_planner(run, Team(torch.device("cpu"))) for run in experiment.runs.values()]
    assert [run.azimuth_deg for run in experiment.runs.values()] == [30, 180, 10]
    angles: list[list[float]] = [[], [], []]
    sources = set()
    for step in range(40):
        plans = [planner.plan(step, 2 * step, 2, 16) for planner in planners]
        for name in ("recoloured", "permutations", "gains", "gammas", "directions", "backgrounds"):
            assert all(torch.equal(getattr(plan, name), getattr(plans[0], name)) for plan in plans[1:])
        for name in ("rectangles", "origins", "crops", "intrinsics"):  # the input, and the target that is the source
            assert all(torch.equal(getattr(plan, name)[:, :2], getattr(plans[0], name)[:, :2]) for plan in plans[1:])
        sources |= {tuple(row) for row in plans[0].rectangles[:, 0].tolist()}
        for plan, found in zip(plans, angles):
            forward = plan.world_to_camera[:, 1, 2, :3]  # a camera's z axis, seen from the source
            found += torch.atan2(forward[:, 0], forward[:, 2]).rad2deg().abs().tolist()
    assert len(sources) == 3 * 5  # not the view at -29 degrees: its nearest neighbour looks 21 degrees from it
    assert max(angles[0]) <= 30.01 and max(angles[2]) <= 10.01 and max(angles[0]) > 20
    assert max(angles[1]) > 90 and min(angles[1]) > 0.5


def test_pictures_and_cameras_of_other_folders_belong_together(folder):
    """The ball at the world's origin must be opaque where the cameras of targets all round project it."""
    experiment, _ = read_experiment(arguments(folder))
    run = replace(experiment.runs["sphere"], augmentation=Augmentation(colour=0.0, target_zoom=(0.9, 1.3)), targets=3)
    planner = make_planner(run, Team(torch.device("cpu")))
    batch = make_batch(planner.plan(3, 9, 3, 32), planner.views)
    for example in range(3):
        for view in range(4):
            x, y, z = (batch.world_to_camera[example, view] @ torch.tensor([0, 0, 1.3, 1.0]))[:3]
            fx, fy, cx, cy = batch.intrinsics[example, view]
            assert z == pytest.approx(1.3, abs=1e-4)
            assert batch.targets[example, view, 3, int(fy * y / z + cy), int(fx * x / z + cx)] > 0.999


def test_neighbours_by_angle():
    cameras = np.stack([look_at(0, 0), look_at(0, 9), look_at(30, 0), look_at(40, 0)])
    assert has_neighbour(cameras, 9.5).tolist() == [True, True, False, False]
    assert has_neighbour(cameras, 10).all()


def trend_of_one(folder, lead, capsys):
    """The comparison as two points of two axes: the table has its lead; a plot; and what is refused."""
    points = [f"steps:4={folder}/runs", f"objects:3={folder}/runs"]
    assert compare_trend.main([*points, "-o", str(folder / "trend")]) == 2
    assert "has the arms sphere, cone_10: expected --other" in capsys.readouterr().err
    assert compare_trend.main([*points, "--other", "sphere", "-o", str(folder / "trend")]) == 0
    table = (folder / "trend.md").read_text()
    assert table == capsys.readouterr().out
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    assert [row[0] for row in rows] == ["varied", "---", "objects 3", "steps 4"]
    assert rows[0][2] == "near, 10 deg" and rows[2][2] == rows[3][2] == compare_report.lead_cell(lead)
    assert min(Image.open(folder / "trend.png").size) > 200
    for wrong in (f"steps={folder}/runs", f"steps:0={folder}/runs", points[0], f"a:1={folder}"):
        assert compare_trend.main([points[0], wrong, "--other", "sphere", "-o", str(folder / "no")]) == 2
    assert not (folder / "no.md").exists()


def test_the_whole_command(folder, capsys, monkeypatch):
    """One arm alone, the report on it, then all arms; what is finished is neither trained nor scored again."""
    command = arguments(folder)
    assert compare.main([*command, "--arm", "sphere"]) == 0
    assert "constrained: targets within 30 degrees of azimuth and 12 of elevation of the source; not finished" in (
        capsys.readouterr().out
    )
    first = losses(folder / "runs/sphere")
    scored = (folder / "runs/sphere/final_scores.json").read_bytes()
    assert compare.main(command) == 0
    printed = capsys.readouterr().out
    assert losses(folder / "runs/sphere") == first and len(first) == 4
    assert (folder / "runs/sphere/final_scores.json").read_bytes() == scored
    assert "not finished" not in printed and "constrained - sphere" in printed and "flat card" in printed
    assert printed.rstrip().endswith((folder / "runs/report.md").read_text().rstrip())
    report = json.loads((folder / "runs/report.json").read_text())
    assert list(report["scores"]) == ["constrained", "sphere", "cone_10"]
    for arm, curve in report["curves"].items():
        assert [row["step"] for row in curve] == [2, 4]
        assert [row["angle_deg"] for row in report["scores"][arm]["near"]["bins"]] == [5, 10]
    for name in ("angles.png", "curves.png"):
        assert min(Image.open(folder / "runs" / name).size) > 200
    trend_of_one(folder, report["leads"]["sphere"]["near"]["10 deg"], capsys)
    monkeypatch.setattr(compare_report, "score_folder", None)
    assert compare.main([*command, "--report-only"]) == 0
    assert json.loads((folder / "runs/report.json").read_text()) == report
    scored = []
    monkeypatch.setattr(
        compare_report, "score_folder", lambda net, data, **_: scored.append(data) or report["scores"]["sphere"]["near"]
    )
    os.utime(folder / "val/object-7/rgb/000000.png")  # a picture is written anew
    assert compare.main([*command, "--report-only"]) == 0
    assert scored == [folder / "val"] * 3
    assert compare.main([*command, "--report-only", "--seed", "1"]) == 2
    assert "another configuration" in capsys.readouterr().err


def test_arms_run_side_by_side_and_may_change_any_field(folder, capsys):
    """Two arms at a time; the third cannot be trained, which is said when the others are done."""
    arms = {"a": {}, "b": {"seed": 3, "augmentation": {"mirror": 0.0}, "optimizer": {"learning_rate": 1e-4}}}
    stages = [{"steps": 2, "image_size_px": 16, "objects": 2}]
    command = arguments(folder, "side", stages=stages, arms=arms | {"c": {"photographs": "none"}})
    experiment, _ = read_experiment(command)
    assert experiment.runs["b"].augmentation == replace(experiment.runs["a"].augmentation, mirror=0.0)
    assert experiment.runs["b"].optimizer == replace(experiment.runs["a"].optimizer, learning_rate=1e-4)
    assert compare.main([*command, "--devices", "2"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "c: failed" in error and f"{folder}/none" in error
    assert compare.main([*command, "--report-only"]) == 0
    printed = capsys.readouterr().out
    assert "- b: " in printed and "; other augmentation, optimizer, seed\n" in printed and "not finished" in printed
    assert len(losses(folder / "side/a")) == len(losses(folder / "side/b")) == 2


def test_an_arm_goes_on_where_it_broke_off(folder, monkeypatch):
    """A run that breaks off in its fourth step, after the checkpoint and the scores of the second."""
    assert compare.main([*arguments(folder, "whole"), "--arm", "constrained"]) == 0
    made, made_before = loop.make_batch, []

    def break_off(*batch):
        made_before.append(batch)
        if len(made_before) == 4:
            raise KeyboardInterrupt
        return made(*batch)

    command = [*arguments(folder, "cut"), "--arm", "constrained"]
    monkeypatch.setattr(loop, "make_batch", break_off)
    assert compare.main(command) == 130
    assert not (folder / "cut/constrained/model.safetensors").exists()
    monkeypatch.undo()
    assert compare.main(command) == 0
    for name in ("losses.jsonl", "scores.jsonl"):
        cut, whole = ((folder / run / "constrained" / name).read_text() for run in ("cut", "whole"))
        assert cut == whole and len(whole.splitlines()) == {"losses.jsonl": 4, "scores.jsonl": 2}[name]


def _report(psnr_db: float, ssim: float, *of_objects: float) -> dict:
    """A plausible result of score_folder: 10 dB more for the source, a decibel less from bin to bin."""

    def row(psnr_db: float) -> dict:
        return {
            "views": 2,
            "psnr_db": psnr_db,
            "ssim": ssim,
            "copy_psnr_db": 20.25,
            "copy_ssim": 0.85,
            "card_psnr_db": 19.5,
            "card_ssim": 0.845,
        }

    return row(psnr_db - 0.5) | {
        "source": row(psnr_db + 10),
        "bins": [{"angle_deg": angle} | row(psnr_db - step) for step, angle in enumerate((5, 10))],
        "object_psnr_db": {str(number): psnr for number, psnr in enumerate(of_objects)},
    }


def test_report_of_known_numbers():
    run = TrainingConfig("out", ["data"], [Stage(10, 16, 4)])
    scores = {"narrow": {"near": _report(28.0, 0.95, 27, 28, 29)}, "round": {"near": _report(27.25, 0.94, 27, 27, 27)}}
    (lead,) = compare_report.leads(scores).values()
    assert {
        label: (row["psnr_db"], pytest.approx(row["ssim"])) for label, row in lead["near"].items()
    } == dict.fromkeys(("source", "5 deg", "10 deg", "all"), (0.75, 0.01))
    lines = compare_report.to_markdown({"narrow": run, "round": run, "late": run}, scores).splitlines()
    assert "| source | 2 | 38.00 / 0.950 | 37.25 / 0.940 | 20.25 / 0.850 | 19.50 / 0.845 |" in lines
    assert "| 10 deg | 2 | 27.00 / 0.950 | 26.25 / 0.940 | 20.25 / 0.850 | 19.50 / 0.845 |" in lines
    assert lead["near"]["all"]["psnr_standard_error"] == pytest.approx(1 / 3**0.5)  # of 0, 1 and 2
    assert "| angle | narrow - round |" in lines and lines.count("| all | +0.75 +- 0.58 / +0.010 |") == 1
    assert any("10 steps, 40 samples of 4 views" in line for line in lines)
    assert [line.endswith("not finished") for line in lines if line.startswith("- ")] == [False, False, True]


@pytest.mark.parametrize(
    "changes, more, message",
    [
        ({}, ["--arm", "square"], "--arm square: expected one of constrained, sphere, cone_10"),
        ({}, ["--neighbour_deg", "11"], "cone_10: its targets lie within 10 degrees"),
        ({"arms": {"a": {"steps": 3}}}, [], "steps"),
        ({"arms": {}}, [], "at least one"),
        ({"arms": {"../a": {}}}, [], "letters"),
        ({}, ["--report-only"], "no finished arm"),
        ({"arms": {"a": {"target_data": ["val"]}}}, [], "3 are missing: object-0"),
        ({"arms": {"a": {"target_data": ["set", "set"]}}}, [], "a folder for each of the 1 of data, got 2"),
    ],
)
def test_bad_comparisons_are_refused_in_one_line(folder, capsys, changes, more, message):
    assert compare.main([*arguments(folder, "unused", **changes), *more]) == 2
    error = capsys.readouterr().err
    assert error.count("error: ") == 1 and message in error.splitlines()[-1] and "Traceback" not in error


def test_torchrun_is_refused(folder, capsys, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    assert compare.main(arguments(folder, "unused")) == 2
    assert "instead of torchrun" in capsys.readouterr().err


def test_runs_are_scored_at_other_sizes_with_detail(folder, capsys):
    """The source view has more of the photo under the sheet; scores without it stay valid beside those with it."""
    scored = {"near": "val", "detail": {"folder": "val", "size_px": 64, "detail": 2}}
    command = arguments(folder, "detail", arms={"a": {}}, scored=scored, validation="")
    assert compare.main(command) == 0
    printed = capsys.readouterr().out
    assert "## detail" in printed and "| holes % / ghosts % | a |" in printed
    of = json.loads((folder / "detail/a/final_scores.json").read_text())["of"]["data"]
    assert of["detail"] == [*of["near"], 64, 2]
    found = json.loads((folder / "detail/report.json").read_text())["scores"]["a"]
    assert found["detail"]["source"]["psnr_db"] > found["near"]["source"]["psnr_db"] + 1


@pytest.mark.parametrize("name", ["arms", "composite-arms", "table2-meshes"])
def test_shipped_comparisons_on_meshes_can_be_read(name):
    experiment, _ = read_experiment(["--config", str(config_path("training", name)), "--data_root", "elsewhere"])
    first, *others = experiment.runs.values()
    assert first.meshes.folder == "elsewhere/meshes" and not first.data
    assert all(objects.folder.startswith("elsewhere/objects/") for objects in experiment.scored.values())
    for run in others:
        changed = set(run.differences(json.loads(json.dumps(first.identity()))))
        assert changed in (
            {"meshes"},
            {"stages"},
            {"attention_px"},
            {"stages", "composite"},
            {"cone_margin"},
            {"cone_deg", "cone_margin", "elevation_deg"},
        )
        assert sum(stage.minutes for stage in run.stages) == sum(stage.minutes for stage in first.stages)
        assert ModelConfig.from_yaml(run.model).image_size_px == run.stages[0].image_size_px


@pytest.mark.parametrize("name", ["compare", "compare-small"])
def test_shipped_comparisons_can_be_read(name):
    path = config_path("training", name)
    experiment, _ = read_experiment(["--config", str(path), "--model", "original", "--data_root", "elsewhere"])
    assert {"constrained": 30, "sphere": 180}.items() <= {
        arm: run.azimuth_deg for arm, run in experiment.runs.items()
    }.items()
    assert all(run.model == "original" for run in experiment.runs.values())
    assert experiment.runs["sphere"].target_data == ["elsewhere/train_sphere"]
    assert "arms" in yaml.safe_load(path.read_text())
    with pytest.raises(InputError):
        read_experiment(["--config", str(path), "--arms", "{a: {sead: 1}}"])
    with pytest.raises(InputError, match="arms: a: cone_margin must be"):
        read_experiment(["--config", str(path), "--arms", "{a: {cone_margin: -1}}"])
