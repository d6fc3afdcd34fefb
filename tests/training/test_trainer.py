"""The weights after a step: the schedule, the average, and the start of a network."""

import copy
import dataclasses

import pytest
import torch
from photo_cases import TINY, tiny_net
from safetensors.torch import load_file
from training_runs import finish, run_config

from lightfield_gs import InputError
from lightfield_gs.models import ModelConfig, SplatterNet
from lightfield_gs.models.crop import Square, crop_resize
from training import average, train
from training.config import OptimizerConfig, Stage, TrainingConfig
from training.data.batches import make_batch
from training.distributed import Team, join_team
from training.drawing import draw, drawings, seen_by_network
from training.loop import make_planner, plans
from training.losses import total_loss
from training.schedule import WeightAverage, learning_rate, progress
from training.trainer import Trainer, with_attention


def test_a_stage_draws_what_a_photo_shows_beside_the_cloud(small_set):
    """The network sees the picture as a photo is reduced, the sheet has all of it, and both losses are added up."""
    stage = {"steps": 2, "image_size_px": 16, "objects": 2, "target_px": 32, "detail": 2, "scales": [1, 2]}
    path = run_config(small_set, "sheet", stages=[stage], composite={"outline": 0.5}, bfloat16=False, dropout=0.0)
    config = train.read_config(["--config", str(path)])
    alone = Team(torch.device("cpu"))
    trainer, planner = Trainer(config, alone), make_planner(config, alone)
    (plan, stage, last), _ = plans(planner, trainer)
    assert not last
    batch = make_batch(plan, planner.views)
    seen, camera = seen_by_network(batch, stage)
    square = Square(0, 0, 32)
    torch.testing.assert_close(seen[1], crop_resize(batch.source[1], square, 16))
    fx, fy, cx, cy = batch.source_intrinsics[1].tolist()
    torch.testing.assert_close(camera[1], torch.tensor(square.intrinsics((fx, fy), (cx, cy), 16)))
    cloud = trainer.net(seen, camera)
    *clouds, composed = drawings(trainer.net.composed, cloud, (seen, camera), batch, stage, config)
    assert [drawing.reduced for drawing in clouds] == [1, 2] and clouds[0].gaussians is cloud
    assert composed.gaussians.means.shape[1] == 32 * 32 + cloud.means.shape[1]
    losses = []
    for drawing in (*clouds, composed):
        images, alpha, targets = draw(drawing, batch)
        assert images.shape[-1] == targets.shape[-1] == 32 // drawing.reduced
        arguments = (batch.backgrounds, cloud.means, seen, drawing.weights)
        losses.append(total_loss(images, alpha, targets, *arguments)[0].item())
    values = trainer.advance(batch, stage).read()
    assert values["loss"] == pytest.approx((losses[0] + losses[1]) / 2 + losses[2], rel=1e-5)
    assert values["gradient_norm"] > 0 and values["composite_outline"] > 0 and "outline" not in values


def test_learning_rate_warms_up_and_falls_by_a_cosine():
    config = OptimizerConfig(learning_rate=1e-3, warmup_steps=10, final_share=0.1)
    run = TrainingConfig("out", ["data"], [Stage(110, 16, 1)], optimizer=config)
    for step, rate in ((0, 1e-4), (10, 1e-3), (60, 1e-3 * 0.55), (110, 1e-4)):
        assert learning_rate(step, progress(step, 0.0, run), config) == pytest.approx(rate)
    timed = dataclasses.replace(run, stages=[Stage(minutes=4, image_size_px=16, objects=1)])
    for step, seconds, rate in ((0, 0.0, 1e-4), (10, 120.0, 1e-3 * 0.55), (99, 240.0, 1e-4), (99, 241.0, 1e-4)):
        assert learning_rate(step, progress(step, seconds, timed), config) == pytest.approx(rate)


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
    finish(config)
    found = SplatterNet.from_pretrained(small_set / "head/model.safetensors")
    assert found.config.symmetric
    changed = {name for name, weights in found.half().state_dict().items() if not torch.equal(weights, former[name])}
    assert changed == {"head.weight", "head.bias"}


def test_attention_that_is_added_begins_without_effect(small_set, tmp_path):
    """The packaged network with attention at 8 px too fits into 15 MB, and predicts as before."""
    path = run_config(small_set, "unused", stages=[{"steps": 1, "image_size_px": 128, "objects": 1}])
    config = train.read_config(["--config", str(path), "--initial_weights", "pretrained"])
    alone, size = Team(torch.device("cpu")), 128
    pictures = torch.rand(1, 4, size, size), torch.tensor([[1.4 * size] * 2 + [size / 2] * 2])
    former, more = (
        Trainer(dataclasses.replace(config, attention_px=sizes), alone).average.average for sizes in ([], [8])
    )
    assert more.config.unet.attention_px == (32, 16, 8)
    with torch.no_grad():
        torch.testing.assert_close(more(*pictures).means, former(*pictures).means)
    more.save(tmp_path / "more.safetensors")
    assert (tmp_path / "more.safetensors").stat().st_size < 15e6
    assert SplatterNet.from_pretrained(tmp_path / "more.safetensors").config == more.config
    with pytest.raises(InputError, match="attention_px: expected sizes of 64, 32, 16, 8 .* got .33."):
        Trainer(dataclasses.replace(config, attention_px=[33]), alone)


def test_a_head_is_trained_on_features_without_dropout(small_set):
    config = train.read_config(["--config", str(run_config(small_set, "unused", dropout=0.5)), "--trained", "head"])
    with join_team("cpu") as team:
        net = Trainer(config, team).net
    torch.nn.init.normal_(net.head.weight)
    for weights in net.unet.parameters():
        torch.nn.init.normal_(weights, std=0.1)
    images, intrinsics = torch.rand(1, 4, 16, 16), torch.tensor([[16.0, 16, 8, 8]])
    assert torch.equal(net(images, intrinsics).means, net(images, intrinsics).means) and net.head.training


@torch.no_grad()
def test_the_mean_with_a_network_that_has_more_attention_lies_between_both():
    """Without weight the second network changes nothing; with all of it the mean is the second network."""
    first, second = tiny_net(), with_attention(tiny_net(), [32])
    for parameter in second.parameters():
        parameter += 0.02 * torch.randn_like(parameter)
    pictures = torch.rand(1, 4, 32, 32), torch.tensor([[40.0, 40.0, 16.0, 16.0]])
    for weight, expected in ((0.0, first), (1.0, second)):
        mean = average.average(copy.deepcopy(first), second, weight)
        assert mean.config == second.config
        torch.testing.assert_close(mean(*pictures).means, expected(*pictures).means)


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
