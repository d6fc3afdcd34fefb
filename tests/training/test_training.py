"""Losses, schedule, and a training loop that resumes with the same numbers."""

import dataclasses
import json
import math
import signal
import time
from itertools import islice
from pathlib import Path

import docstring_parser
import numpy as np
import pytest
import torch
import yaml
from photo_cases import TINY, tiny_net
from safetensors.torch import load_file
from training_runs import losses, run_config, start

from lightfield_gs import InputError
from lightfield_gs.base.paths import config_names, config_path
from lightfield_gs.models import ModelConfig, SplatterNet
from lightfield_gs.reference.metrics import gradient_psnr_db, psnr_db, ssim
from training import average, train
from training.checkpoints import cut_log, load_checkpoint
from training.config import OptimizerConfig, Stage, TrainingConfig
from training.data.batches import make_batch
from training.data.plan import Augmentation
from training.distributed import Team, join_team
from training.loop import make_planner, plans
from training.losses import LossWeights, composite, gradient_error, roughness, total_loss, translucency
from training.schedule import WeightAverage, learning_rate
from training.trainer import Trainer

pytestmark = pytest.mark.long_file


def test_psnr_of_a_constant_error():
    image = torch.rand(2, 3, 8, 8)
    torch.testing.assert_close(psnr_db(image, image + 0.1), torch.full((2,), 20.0), atol=1e-3, rtol=0)
    assert psnr_db(image, image).tolist() == [100, 100]


def test_ssim_is_the_published_formula():
    """Against sums written out pixel by pixel in float64."""
    rng = np.random.default_rng(0)
    x, y = rng.random((3, 13, 17)), rng.random((3, 13, 17))
    taps = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window = np.outer(taps, taps) / taps.sum() ** 2
    padded = [np.pad(a, ((0, 0), (5, 5), (5, 5))) for a in (x, y)]
    total = []
    for c, i, j in np.ndindex(x.shape):
        a, b = (p[c, i : i + 11, j : j + 11] for p in padded)
        mean_a, mean_b = (window * a).sum(), (window * b).sum()
        var_a, var_b = (window * a * a).sum() - mean_a**2, (window * b * b).sum() - mean_b**2
        covariance = (window * a * b).sum() - mean_a * mean_b
        total.append(
            (2 * mean_a * mean_b + 1e-4)
            * (2 * covariance + 9e-4)
            / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))
        )
    assert float(ssim(torch.from_numpy(x), torch.from_numpy(y))) == pytest.approx(np.mean(total), abs=1e-12)
    assert float(ssim(torch.from_numpy(x).float(), torch.from_numpy(x).float())) == pytest.approx(1, abs=1e-5)


def test_loss_is_the_weighted_sum_of_its_terms():
    targets, backgrounds = torch.rand(2, 3, 4, 16, 16), torch.rand(2, 3, 3)
    targets[:, :, :3] *= targets[:, :, 3:]
    wanted = composite(targets, backgrounds)
    expected = targets[0, 1, :3, 4, 5] + (1 - targets[0, 1, 3, 4, 5]) * backgrounds[0, 1]
    torch.testing.assert_close(wanted[0, 1, :, 4, 5], expected)
    scene = torch.ones(2, 16 * 16, 3), torch.rand(2, 4, 16, 16)
    zero, _ = total_loss(wanted, targets[:, :, 3], targets, backgrounds, *scene, LossWeights())
    assert float(zero) == pytest.approx(0, abs=1e-5)
    weights = LossWeights(2.0, ssim=0.5, alpha=3.0)
    total, terms = total_loss(wanted + 0.1, targets[:, :, 3] - 0.2, targets, backgrounds, *scene, weights)
    assert float(terms["colour"]) == pytest.approx(0.01, abs=1e-6)
    assert float(terms["alpha"]) == pytest.approx(0.04, abs=1e-6)
    assert float(total) == pytest.approx(2 * 0.01 + 0.5 * float(terms["ssim"]) + 3 * 0.04, abs=1e-6)


def test_the_logarithm_of_errors_is_that_of_each_image():
    targets, backgrounds = torch.zeros(2, 1, 4, 16, 16), torch.zeros(2, 1, 3)
    images = torch.tensor([0.1, 0.3]).view(2, 1, 1, 1, 1).expand(2, 1, 3, 16, 16)
    scene = torch.ones(2, 16 * 16, 3), torch.zeros(2, 4, 16, 16)
    weights = LossWeights(colour=0, log_colour=0.5, ssim=0, alpha=0)
    total, _ = total_loss(images, targets[:, :, 3], targets, backgrounds, *scene, weights)
    assert float(total) == pytest.approx(0.5 * (math.log(0.01 + 1e-4) + math.log(0.09 + 1e-4)) / 2, rel=1e-5)


def test_the_gradient_term_is_what_sharpness_is_scored_by():
    images, wanted = torch.rand(2, 3, 4, 20, 20)[:, :, :3].unbind(0)
    scores = gradient_psnr_db(images, wanted)
    assert float(gradient_error(images, wanted)) == pytest.approx(float((10 ** (-scores / 10)).mean()), rel=1e-5)
    scene = torch.ones(1, 256, 3), torch.zeros(1, 4, 16, 16)
    targets, backgrounds = torch.zeros(1, 2, 4, 16, 16), torch.zeros(1, 2, 3)
    alternating = (torch.arange(16) % 2).float().expand(1, 2, 3, 16, 16)  # all differences along rows are 1
    weights = LossWeights(colour=0, ssim=0, alpha=0, gradient=3)
    total, terms = total_loss(alternating, targets[:, :, 3], targets, backgrounds, *scene, weights)
    assert float(terms["gradient"]) == pytest.approx(0.5) and float(total) == pytest.approx(1.5)
    flat, _ = total_loss(0 * alternating + 0.4, targets[:, :, 3], targets, backgrounds, *scene, weights)
    assert float(flat) == 0


def test_translucency_turns_doubt_about_an_outline_into_a_decision():
    chance = torch.tensor(0.7)  # that the pixel is object
    opacities = torch.linspace(0, 1, 1001)
    errors = chance * (1 - opacities).square() + (1 - chance) * opacities.square()
    for weight, best in ((0.0, 0.7), (0.25, 0.766666), (0.5, 0.9), (0.8, 1.0), (2.0, 1.0)):
        costs = errors + weight * torch.stack([translucency(alpha) for alpha in opacities])
        assert float(opacities[costs.argmin()]) == pytest.approx(best, abs=1.5e-3)  # where its derivative is zero
    scene = torch.ones(1, 256, 3), torch.zeros(1, 4, 16, 16)
    alpha, targets = torch.full((1, 2, 16, 16), 0.25), torch.zeros(1, 2, 4, 16, 16)
    images, backgrounds = torch.zeros(1, 2, 3, 16, 16), torch.zeros(1, 2, 3)
    total, terms = total_loss(images, alpha, targets, backgrounds, *scene, LossWeights(ssim=0, alpha=0, translucency=2))
    assert float(terms["translucency"]) == pytest.approx(0.1875) and float(total) == pytest.approx(0.375)


def test_roughness_counts_steps_of_disparity_on_the_object():
    disparity = torch.full((2, 6, 8), 0.8)  # two layers of 6 x 8 pixels
    disparity[0, :, 4:] = 0.9
    means = torch.zeros(1, 96, 3)
    means[0, :, 2] = 1 / disparity.flatten()
    grey = torch.full((1, 4, 6, 8), 0.5)
    grey[:, 3] = 1
    # One step of 0.1 in each of 6 rows of one layer, among 2 x 6 x 7 pairs along rows; none along columns.
    assert float(roughness(means, grey)) == pytest.approx(6 * 0.1 / (2 * 6 * 7), rel=1e-4)
    grey[0, 3, :, 4] = 0  # the step lies outside the object
    assert float(roughness(means, grey)) == pytest.approx(0, abs=1e-6)
    grey[0, 3], grey[0, :3, :, 4:] = 1, 0.8  # the step lies on an edge of the picture
    assert float(roughness(means, grey)) == pytest.approx(6 * 0.1 * math.exp(-3) / (2 * 6 * 7), rel=1e-3)


def test_a_share_of_the_steps_is_under_the_sheet_of_detail(small_set):
    """With half of them the first is as without, and the second has another loss, which teaches the network."""
    alone = Team(torch.device("cpu"))
    steps = []
    for detail in (0.0, 0.5):
        config = train.read_config(["--config", str(run_config(small_set, f"detail-{detail}", detail=detail))])
        trainer, planner = Trainer(config, alone), make_planner(config, alone)
        batches = (make_batch(plan, planner.views) for plan in islice(plans(planner, config, 0, alone), 2))
        steps.append([trainer.advance(batch).read() for batch in batches])
    plain, under = steps
    assert under[0] == plain[0] and under[1]["loss"] != plain[1]["loss"]
    assert under[1]["gradient_norm"] > 0


def test_learning_rate_warms_up_and_falls_by_a_cosine():
    config = OptimizerConfig(learning_rate=1e-3, warmup_steps=10, final_share=0.1)
    assert learning_rate(0, 110, config) == pytest.approx(1e-4)
    assert learning_rate(10, 110, config) == pytest.approx(1e-3)
    assert learning_rate(60, 110, config) == pytest.approx(1e-3 * 0.55)
    assert learning_rate(110, 110, config) == pytest.approx(1e-4)


def test_weight_average_follows_its_recurrence():
    net, average = torch.nn.Linear(2, 1), torch.nn.Linear(2, 1)
    average.load_state_dict(net.state_dict())
    expected, mean = net.weight.detach().clone(), WeightAverage(average, net, decay=0.5)
    for step in range(20):
        with torch.no_grad():
            net.weight += 1
        decay = min(0.5, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * net.weight.detach()
        mean.update(step)
    torch.testing.assert_close(mean.average.weight, expected)


def test_stages_count_steps_and_examples():
    config = TrainingConfig("out", ["data"], [Stage(10, 64, 8), Stage(5, 128, 4)])
    assert config.total_steps == 15
    assert config.stage_at(9) == (config.stages[0], 72)
    assert config.stage_at(12) == (config.stages[1], 88)
    with pytest.raises(IndexError):
        config.stage_at(15)


def test_log_is_cut_at_the_resumed_step(tmp_path):
    log = tmp_path / "losses.jsonl"
    log.write_text("".join(json.dumps({"step": step}) + "\n" for step in range(5)) + '{"step": 5, "lo')
    cut_log(log, 3)
    assert [json.loads(line)["step"] for line in log.read_text().splitlines()] == [0, 1, 2]


@pytest.mark.parametrize("line", ['{"step": 5, "lo', "5", "[1]", "null", "{}", '{"step": "two"}'])
def test_log_is_cut_at_a_damaged_line(tmp_path, line):
    log = tmp_path / "losses.jsonl"
    log.write_text('{"step": 0}\n' + line + '\n{"step": 1}\n')
    cut_log(log, 3)
    assert log.read_text() == '{"step": 0}\n'


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        PermissionError(13, "Permission denied"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate"),
        torch.OutOfMemoryError("CUDA out of memory."),
    ],
)
def test_a_checkpoint_is_not_called_damaged_for_want_of_memory_or_rights(tmp_path, monkeypatch, error):
    """The message would have the user remove it."""
    monkeypatch.setattr(torch, "load", lambda *_, **__: (_ for _ in ()).throw(error))
    with pytest.raises(type(error)) as caught:
        load_checkpoint(tmp_path / "last.pt", TrainingConfig("out", ["data"], [Stage(1, 16, 1)]))
    assert caught.value is error


def _interrupt(config: Path, output: Path, number: int) -> str:
    """Start a run, signal it once a checkpoint exists and a later step is logged; returns what it printed."""
    process = start(config)
    deadline = time.monotonic() + 120
    while not ((output / "last.pt").exists() and len(losses(output)) >= 5):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()[0]
        time.sleep(0.002)
    process.send_signal(number)
    return process.communicate(timeout=120)[0]


def _finish(config: Path) -> None:
    process = start(config)
    assert process.wait(timeout=120) == 0, process.communicate()[0]


def test_killed_run_resumes_to_the_same_losses(small_set):
    """kill -9 in the middle, resume, and compare with a run that was left alone: every digit of every step."""
    validated = {
        "validation": str(small_set / "set"),
        "validate_every": 4,
        "validation_objects": 1,
        "threads": 1,
        "procedural": 0.5,
    }
    whole, killed = (run_config(small_set, name, **validated) for name in ("whole", "killed"))
    _finish(whole)
    _interrupt(killed, small_set / "killed", signal.SIGKILL)
    assert len(losses(small_set / "killed")) < 12
    _finish(killed)
    assert losses(small_set / "killed") == losses(small_set / "whole")
    assert len(losses(small_set / "whole")) == 12
    scores = [(small_set / name / "scores.jsonl").read_text().splitlines() for name in ("killed", "whole")]
    assert scores[0] == scores[1] and [json.loads(line)["step"] for line in scores[1]] == [4, 8, 12]
    assert all(math.isfinite(json.loads(line)["loss"]) for line in losses(small_set / "whole"))
    weights = [load_file(small_set / name / "model.safetensors") for name in ("killed", "whole")]
    assert all(torch.equal(weights[0][name], weights[1][name]) for name in weights[1])
    assert list((small_set / "whole/tensorboard").iterdir())


def test_scores_that_a_run_owes_are_taken_when_it_goes_on(small_set):
    """A run killed after a checkpoint and before its scores; a line of a step that is taken again is dropped."""
    config = run_config(
        small_set, "owing", validation=str(small_set / "set"), validate_every=6, validation_objects=1, threads=1
    )
    _finish(config)
    log = small_set / "owing/scores.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text(lines[0] + json.dumps({"step": 13, "psnr_db": 0}) + "\n")
    _finish(config)
    assert log.read_text() == "".join(lines) and len(lines) == 2


def test_terminated_run_saves_its_last_step(small_set):
    config = run_config(small_set, "terminated", stages=[{"steps": 400, "image_size_px": 16, "objects": 2}])
    printed = _interrupt(config, small_set / "terminated", signal.SIGTERM)
    assert "run the same command to resume" in printed
    state = torch.load(small_set / "terminated/last.pt", weights_only=True)
    assert state["step"] == len(losses(small_set / "terminated"))
    process = start(run_config(small_set, "terminated", seed=1))
    message = process.communicate(timeout=120)[0]
    assert process.returncode == 2 and "another configuration (seed, stages differ)" in message
    (small_set / "terminated/last.pt").write_bytes(b"damaged")
    process = start(config)
    message = process.communicate(timeout=120)[0]
    assert process.returncode == 2 and "damaged checkpoint" in message and "Traceback" not in message


@pytest.mark.parametrize(
    "arguments, word",
    [
        (["--config", "none.yaml"], "none.yaml"),
        (["--seed", "x"], "seed"),
        (["--steps", "5"], "steps"),
        (["--stages", "[{steps: 5}]"], "stages"),
        (["--device", "gpu"], "device"),
    ],
)
def test_bad_arguments_are_reported_in_one_line(small_set, capsys, arguments, word):
    assert train.main(["--config", str(run_config(small_set, "unused")), *arguments]) == 2
    error = capsys.readouterr().err
    assert word in error and error.count("\n") == 1


def test_help_says_what_every_field_is(capsys):
    for owner in (TrainingConfig, OptimizerConfig, LossWeights, Augmentation, Stage):
        described = {entry.arg_name: entry.description for entry in docstring_parser.parse(owner.__doc__).params}
        assert list(described) == [field.name for field in dataclasses.fields(owner)] and all(described.values())
    with pytest.raises(SystemExit):
        train.main(["--help"])
    said = " ".join(capsys.readouterr().out.split())
    for words in (
        "the panel's full viewing cone, degrees",
        "last learning rate / peak",
        "of 1 - SSIM",
        "largest turn of the target cameras",
    ):
        assert words in said


@pytest.mark.parametrize(
    "error, words, code",
    [
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB."), "take fewer objects", 2),
        (OSError(28, "No space left on device"), "No space left", 2),
        (KeyboardInterrupt(), "interrupted", 130),
    ],
)
def test_what_ends_a_run_is_said_in_one_line(small_set, capsys, monkeypatch, error, words, code):
    monkeypatch.setattr(train, "train", lambda config: (_ for _ in ()).throw(error))
    assert train.main(["--config", str(run_config(small_set, "unused"))]) == code
    said = capsys.readouterr().err
    assert said.startswith("training.train: error: ") and words in said and said.count("\n") == 1


STAGE = {"steps": 2, "image_size_px": 16, "objects": 2}


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"stages": []}, "stages: expected at least one"),
        ({"data": []}, "data: expected at least one"),
        ({"output_dir": ""}, "output_dir: expected a folder"),
        ({"output_dir": __file__}, "cannot make the folder"),
        ({"cache_dir": __file__}, "cannot make the folder"),
        ({"validation": "nowhere"}, "nowhere: expected a folder of objects"),
        *[
            ({"stages": [STAGE | {field: value}]}, f"stages: {field}")
            for field, value in (
                ("steps", 0),
                ("steps", -3),
                ("image_size_px", 0),
                ("image_size_px", 15),
                ("objects", 0),
                ("target_px", -4),
            )
        ],
        *[
            ({field: value}, f"{field} must be")
            for field, value in (
                ("seed", -1),
                ("seed", 2**31),
                ("cone_deg", -5.0),
                ("cone_deg", math.nan),
                ("cone_margin", -1.0),
                ("elevation_deg", -1.0),
                ("neighbour_deg", math.inf),
                ("targets", 0),
                ("procedural", -0.1),
                ("procedural", 1.5),
                ("procedural", math.nan),
                ("checkpoint_every", 0),
                ("validate_every", 0),
                ("validation_objects", 0),
                ("threads", -1),
            )
        ],
        *[
            ({"optimizer": {field: value}}, f"optimizer.{field} must be")
            for field, value in (
                ("learning_rate", -1.0),
                ("learning_rate", math.nan),
                ("betas", [0.9, 1.0]),
                ("weight_decay", -1.0),
                ("warmup_steps", -1),
                ("final_share", 2.0),
                ("clip", 0.0),
                ("ema_decay", 2.0),
            )
        ],
        ({"loss": {"colour": math.inf}}, "loss.colour must be"),
        ({"loss": {"colour": 0, "ssim": 0, "alpha": 0}}, "loss: expected a weight above 0"),
        ({"augmentation": {"mirror": 1.5}}, "augmentation.mirror must be"),
        ({"augmentation": {"target_zoom": [0.0, 1.0]}}, "augmentation.target_zoom must be"),
        ({"augmentation": {"target_zoom": [2.0, 0.5]}}, "augmentation.target_zoom: expected the smaller number first"),
    ],
)
def test_numbers_out_of_range_are_refused_before_the_first_step(small_set, capsys, changes, words):
    assert train.main(["--config", str(run_config(small_set, "refused", **changes))]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("training.train: error: ") and words in error
    assert not losses(small_set / "refused")


def test_a_run_can_start_from_a_checkpoint(small_set, tmp_path):
    """Weights and configuration are the checkpoint's, whatever model says; averages begin there too."""
    config = train.read_config(["--config", str(run_config(small_set, "unused"))])
    net = SplatterNet(ModelConfig.from_yaml(config.model))
    net.save(tmp_path / "weights.safetensors")
    changes = ["--initial_weights", str(tmp_path / "weights.safetensors"), "--model", "original"]
    config = train.read_config(["--config", str(run_config(small_set, "unused")), *changes])
    with join_team("cpu") as team:
        trainer = Trainer(config, team)
    for found in (trainer.net, trainer.average.average):
        assert found.config == net.config and found.training == (found is trainer.net)
        for name, weights in net.state_dict().items():
            torch.testing.assert_close(found.state_dict()[name], weights.half().float(), atol=0, rtol=0)
            assert found is not trainer.net or dict(trainer.net.named_parameters())[name].requires_grad


def test_a_trained_network_can_be_made_symmetric_and_its_head_trained_alone(small_set, tmp_path):
    config = train.read_config(["--config", str(run_config(small_set, "unused"))])
    SplatterNet(ModelConfig.from_yaml(config.model)).save(tmp_path / "weights.safetensors")
    former = load_file(tmp_path / "weights.safetensors")
    config = run_config(
        small_set,
        "head",
        initial_weights=str(tmp_path / "weights.safetensors"),
        symmetric=True,
        trained="head",
        threads=1,
    )
    _finish(config)
    found = SplatterNet.from_pretrained(small_set / "head/model.safetensors")
    assert found.config.symmetric
    changed = {name for name, weights in found.half().state_dict().items() if not torch.equal(weights, former[name])}
    assert changed == {"head.weight", "head.bias"}


def test_a_head_is_trained_on_features_without_dropout(small_set):
    config = train.read_config(["--config", str(run_config(small_set, "unused", dropout=0.5)), "--trained", "head"])
    with join_team("cpu") as team:
        net = Trainer(config, team).net
    torch.nn.init.normal_(net.head.weight)
    for weights in net.unet.parameters():
        torch.nn.init.normal_(weights, std=0.1)
    images, intrinsics = torch.rand(1, 4, 16, 16), torch.tensor([[16.0, 16, 8, 8]])
    assert torch.equal(net(images, intrinsics).means, net(images, intrinsics).means) and net.head.training


def test_two_checkpoints_have_a_mean(tmp_path, capsys):
    nets, paths = [tiny_net() for _ in range(2)], [tmp_path / f"{name}.safetensors" for name in "abc"]
    for net, value, path in zip(nets, (1.0, 3.0), paths):
        torch.nn.init.constant_(net.head.weight, value)
        net.save(path)
    assert average.main([str(path) for path in paths[:2]] + ["--share", "0.25", "-o", str(paths[2])]) == 0
    mean = SplatterNet.from_pretrained(paths[2])
    assert mean.config == nets[0].config and set(mean.head.weight.flatten().tolist()) == {1.5}
    torch.testing.assert_close(mean.unet.stem.weight, nets[0].unet.stem.weight.half().float(), atol=0, rtol=0)
    SplatterNet(ModelConfig.from_dict(TINY | {"layers": 1})).save(paths[1])
    for words in ([], ["--share", "2"]):
        assert average.main([str(path) for path in paths[:2]] + [*words, "-o", str(tmp_path / "d.safetensors")]) == 2
        assert "expected" in capsys.readouterr().err and not (tmp_path / "d.safetensors").exists()


def test_a_run_that_was_stored_before_a_field_existed_has_its_default():
    config = TrainingConfig("out", ["data"], [Stage(5, 16, 2)])
    stored = json.loads(json.dumps(config.identity()))
    del stored["symmetric"], stored["augmentation"]["noise"]
    assert config.differences(stored) == []
    stored["augmentation"]["mirror"] = 0.25
    assert config.differences(stored | {"seed": 3}) == ["augmentation", "seed"]
    assert "stages" in config.differences(None) and "unet" in config.differences(stored | {"unet": {}})


def test_a_run_with_other_data_is_another_unless_the_folders_were_moved():
    config = TrainingConfig("out", ["data/cone"], [Stage(5, 16, 2)], target_data=["data/sphere"])
    stored = json.loads(json.dumps(config.identity()))
    moved = dataclasses.replace(config, data=["/elsewhere/cone/"], target_data=["sphere"])
    assert moved.differences(stored) == []
    other = dataclasses.replace(config, data=["data/sphere", "data/cone"], target_data=[])
    assert other.differences(stored) == ["data", "target_data"]
    del stored["data"], stored["target_data"]  # as they were stored before
    assert other.differences(stored) == []


SHIPPED = [
    name for name in config_names("training") if "arms" not in yaml.safe_load(config_path("training", name).read_text())
]  # those are comparisons


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_configurations_can_be_read(name):
    config = train.read_config(["--config", str(config_path("training", name))])
    assert config.total_steps > 0
    assert ModelConfig.from_yaml(config.model).image_size_px == config.stages[-1].image_size_px


def test_a_comparison_is_sent_to_its_own_command():
    with pytest.raises(InputError, match="several arms is for python -m training.compare"):
        train.read_config(["--config", str(config_path("training", "compare"))])
