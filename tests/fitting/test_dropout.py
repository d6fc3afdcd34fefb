"""Dropout: the Gaussians that a step leaves out, their number, and the gradients of the step."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from fit_capture import write_capture
from fit_scene import first_state, known_scene, photograph_scene

import lightfield_gs as lf
from lightfield_gs import _core, render
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient
from lightfield_gs.fitting.random import dropout
from lightfield_gs.fitting.schedule import Schedule
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer

SEED = 2**33 + 5
RATES = torch.tensor([0.0, 0.25, 0.5])


def at(step: int) -> torch.Tensor:
    return torch.tensor(step)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_who_is_left_out_is_a_matter_of_seed_step_and_index(dtype):
    found = dropout(RATES.to(dtype), at(2), SEED, 7)
    for i in range(7):
        word = _core.philox4x32([i // 4, 0, 2, _core.DROPOUT_PURPOSE], [5, 2])[i % 4]
        assert found[i] == (0 if word / 2**32 < 0.5 else 2)
    assert torch.equal(dropout(RATES.to(dtype), at(2), SEED, 20_001)[:7], found)


def test_as_many_as_asked_are_left_out_and_the_mean_stays():
    count = 200_000
    for step, share in enumerate(RATES.tolist()):
        factors = dropout(RATES, at(step), 1, count)
        assert abs(float((factors == 0).double().mean()) - share) <= 4 * (share / count) ** 0.5
        assert abs(float(factors.double().mean()) - 1) <= 8 * (share / count) ** 0.5
    for beyond in (-1, 3):
        assert (dropout(RATES, at(beyond), 1, 100) == 1).all()


def test_gradients_of_a_step_are_those_of_what_it_draws():
    settings = FitSettings(steps=4, cap_max=150, dropout=0.8, init_opa=0.1)
    images = photograph_scene(known_scene())
    trainer = Trainer(first_state(known_scene(), settings), images, settings)
    trainer.counters.step.fill_(3)
    chosen = torch.tensor([1])
    found = trainer._gradients(chosen, None)
    factors = dropout(trainer.schedule.dropouts, at(3), settings.seed, 150)
    assert (
        float(trainer.schedule.dropouts[3]) == pytest.approx(0.8 * 0.25 / 0.3) and 40 < int((factors == 0).sum()) < 120
    )
    scene = trainer.state.gaussians()
    opacities = scene.opacities.clone().requires_grad_()
    image = render(
        replace(scene, opacities=opacities * factors), images.cameras().select(slice(1, 2)), background=(0, 0, 0)
    ).image
    gradient = photo_loss_and_gradient(image.detach(), images.photos[1:2], None, settings.ssim_lambda)[1]
    (expected,) = torch.autograd.grad(image, opacities, gradient)
    assert expected.abs().max() > 0
    torch.testing.assert_close(found.gaussians.opacities, expected, rtol=1e-4, atol=1e-6 * float(expected.abs().max()))


@pytest.mark.parametrize("photographs", [3, 9, 12, 200])
def test_none_are_left_out_unless_asked_for(photographs):
    assert Schedule.make(FitSettings(steps=10), photographs, "cpu").dropouts is None
    rates = Schedule.make(FitSettings(steps=10, dropout=0.2), photographs, "cpu").dropouts
    shares = [0, 1 / 7, 2 / 7, 3 / 7, 4 / 7, 5 / 7, 6 / 7, 1, 2 / 3, 1 / 3]
    torch.testing.assert_close(rates, 0.2 * torch.tensor(shares))


def test_a_fit_to_few_photographs_says_what_it_leaves_out(tmp_path, capsys):
    capture = write_capture(tmp_path / "capture", count=13)
    lines = []
    for given in (dict(test_every=8), dict(test_every=8, dropout=0.2), dict(test_every=None)):
        result = lf.fit(capture, steps=2, cap_max=200, device="cpu", **given)
        said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("steps leave out")]
        lines.append((result.settings.dropout, said))
    few = (
        "steps leave out no Gaussians: with 11 photographs a dropout of 0.1 gains up to 0.4 dB or loses up to 0.1, by "
        "the scene; compare the PSNR of photographs held out"
    )
    assert lines == [
        (0.0, [few]),
        (0.2, ["steps leave out a random part of the Gaussians, up to 20% (dropout)"]),
        (0.0, []),
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(rates=RATES.long()), "must be float32"),
        (dict(rates=RATES[None]), r"must be \[steps\]"),
        (dict(step=torch.tensor(1.0)), "must be torch.int64"),
        (dict(seed=-1), "seed"),
        (dict(count=-1), "count"),
    ],
)
def test_what_cannot_be_is_refused(change, words):
    with pytest.raises(InputError, match=words):
        dropout(**{**dict(rates=RATES, step=at(0), seed=0, count=3), **change})
