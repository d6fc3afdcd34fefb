"""The fused step of the optimiser, against torch: Adam, with the chain rule and the regularisers by autograd."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.optimizer import (
    MOST_LOG_SCALE,
    MOST_LOGIT,
    Gradients,
    RawParameters,
    activate,
    update,
    update_table,
)
from lightfield_gs.fitting.random import Purpose, normals

RATES = dict(means_lr=2e-3, scales_lr=5e-3, quats_lr=1e-3, opacities_lr=0.05, sh0_lr=2.5e-3, shN_lr=1.25e-4)
DOUBLE = torch.float64


def make_parameters(count: int = 40, harmonics: int = 4, dtype: torch.dtype = DOUBLE) -> RawParameters:
    random = torch.Generator().manual_seed(count)

    def draw(*shape: int) -> Tensor:
        return torch.randn(shape, dtype=DOUBLE, generator=random).to(dtype)

    return RawParameters(draw(count, 3), draw(count, 3) - 3, draw(count, 4), draw(count), draw(count, harmonics, 3))


@dataclass
class Run:
    """Parameters under optimisation, with the other arguments of an update."""

    values: RawParameters
    table: Tensor
    seed: int = 5

    def __post_init__(self) -> None:
        self.first, self.second = self.values.zeros_like(), self.values.zeros_like()
        self.scales, self.opacities = activate(self.values)
        self.step, self.skipped = torch.zeros((), dtype=torch.int64), torch.zeros((), dtype=torch.int64)

    def update(self, gradients: Gradients, **options: object) -> None:
        arguments = dict(table=self.table, step=self.step, skipped=self.skipped, seed=self.seed) | options
        update(self.values, self.first, self.second, gradients, self.scales, self.opacities, **arguments)
        self.step += 1


def some_gradients(values: RawParameters, step: int) -> Gradients:
    random = torch.Generator().manual_seed(1000 + step)
    shapes = values.means, values.quaternions, values.log_scales, values.logits, values.sh
    return Gradients(*(torch.randn(t.shape, dtype=DOUBLE, generator=random).to(t) for t in shapes))


@pytest.mark.parametrize("harmonics", [1, 4, 9, 16])
@pytest.mark.parametrize("seen", [False, True])
def test_fifty_steps_are_those_of_torch(harmonics, seen):
    steps, regs = 50, dict(opacity_reg=0.01, scale_reg=0.02)
    means = torch.linspace(2e-3, 2e-5, steps, dtype=DOUBLE)
    run = Run(
        make_parameters(harmonics=harmonics), update_table(steps, **RATES | dict(means_lr=means), **regs, dtype=DOUBLE)
    )
    mask = (torch.arange(40) % 3 > 0).to(torch.uint8) if seen else None
    leaves = RawParameters(*(field.clone().requires_grad_() for field in run.values))
    dc, rest = leaves.sh[:, :1].detach().requires_grad_(), leaves.sh[:, 1:].detach().requires_grad_()
    groups = [leaves.means, leaves.log_scales, leaves.quaternions, leaves.logits, dc, rest]
    adam = torch.optim.Adam([dict(params=[p], lr=rate) for p, rate in zip(groups, RATES.values())], eps=1e-15)
    for step in range(steps):
        gradients = some_gradients(run.values, step)
        run.update(gradients, seen=mask)
        adam.param_groups[0]["lr"] = float(means[step])
        drawn = [
            leaves.means,
            leaves.quaternions,
            leaves.log_scales.exp(),
            leaves.logits.sigmoid(),
            torch.cat([dc, rest], 1),
        ]
        counts = torch.ones(40, dtype=DOUBLE) if mask is None else mask.double()
        loss = sum((field * gradient).sum() for field, gradient in zip(drawn, gradients))
        loss = loss + 0.01 * (counts * drawn[3]).mean() + 0.02 * (counts[:, None] * drawn[2]).mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    expected = [*(group.detach() for group in groups[:4]), torch.cat([dc, rest], 1).detach()]
    for name, found, value in zip(RawParameters._fields, run.values, expected):
        torch.testing.assert_close(found, value, rtol=1e-9, atol=1e-11, msg=name)
    for found, value in zip((run.scales, run.opacities), activate(run.values)):
        torch.testing.assert_close(found, value, rtol=1e-14, atol=0)
    assert run.skipped == 0


def test_float32_follows_float64():
    found = []
    for dtype in (torch.float32, DOUBLE):
        run = Run(make_parameters(1500, 16, dtype), update_table(20, **RATES, noise_lr=30.0, dtype=dtype))
        for step in range(20):
            run.update(some_gradients(run.values, step))
        found.append(run.values)
    for name, single, double in zip(RawParameters._fields, *found):
        assert (single.double() - double).abs().max() < 1e-4, name


def rotations(q: Tensor) -> Tensor:
    """[N,3,3] from unit quaternions, column by column: q e q*."""
    w, u = q[:, :1], q[:, 1:]

    def turned(axis: Tensor) -> Tensor:
        e = axis.expand_as(u)
        return e + 2 * torch.linalg.cross(u, w * e + torch.linalg.cross(u, e))

    return torch.stack([turned(axis) for axis in torch.eye(3, dtype=q.dtype)], 2)


def test_noise_is_that_of_mcmc():
    values = make_parameters(50)
    values.logits[:] = torch.linspace(-9, 2, 50, dtype=DOUBLE)
    run = Run(
        values,
        update_table(4, **dict.fromkeys(RATES, 0.0) | dict(means_lr=1e-3), noise_lr=[0, 0, 5e5, 0], dtype=DOUBLE),
    )
    nothing = Gradients(*(torch.zeros_like(g) for g in some_gradients(values, 0)))
    before = values.means.clone()
    run.update(nothing)
    assert torch.equal(values.means, before)
    run.step += 1
    run.update(nothing)
    z = normals(run.seed, 2, Purpose.NOISE, 200, DOUBLE).view(50, 4)[:, :3]
    turned = rotations(values.quaternions / values.quaternions.norm(dim=1, keepdim=True)) @ torch.diag_embed(run.scales)
    gate = torch.sigmoid(100 * (0.005 - run.opacities))[:, None]
    expected = (turned @ turned.mT @ z[..., None]).squeeze(-1) * gate * 1e-3 * 5e5
    torch.testing.assert_close(values.means - before, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("field", range(5))
@pytest.mark.parametrize("value", [math.nan, math.inf, 1e30])
def test_gaussians_with_gradients_that_are_no_numbers_are_left_alone(field, value):
    run = Run(make_parameters(), update_table(3, **RATES, noise_lr=5e5, opacity_reg=0.01, dtype=DOUBLE))
    gradients = some_gradients(run.values, 0)
    gradients[field][7].view(-1)[-1] = value
    tensors = [*run.values, *run.first, *run.second, run.scales, run.opacities]
    before = [tensor.clone() for tensor in tensors]
    run.update(gradients)
    assert run.skipped == 1
    for tensor, old in zip(tensors, before):
        assert torch.equal(tensor[7], old[7]) and not torch.equal(tensor, old)


def test_parameters_stay_within_their_limits():
    run = Run(make_parameters(), update_table(200, **RATES | dict(scales_lr=1.0, opacities_lr=1.0)))
    run = Run(RawParameters(*(field.float() for field in run.values)), run.table)
    signs = (-1.0) ** torch.arange(40)
    gradients = Gradients(*(torch.zeros_like(g) for g in some_gradients(run.values, 0)))
    for _ in range(60):
        gradients.scales[:] = (signs[:, None] / run.scales).clamp(-1e15, 1e15)
        gradients.opacities[:] = signs / (run.opacities * (1 - run.opacities))
        run.update(gradients)
    assert torch.equal(run.values.log_scales.abs(), torch.full_like(run.values.log_scales, MOST_LOG_SCALE))
    assert torch.equal(run.values.logits.abs(), torch.full_like(run.values.logits, MOST_LOGIT))
    assert 0 < run.opacities.min() and run.opacities.max() < 1 and run.scales.isfinite().all()
    assert torch.log1p(-run.opacities).isfinite().all()


def test_any_number_of_threads_gives_the_same_bits():
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            run = Run(make_parameters(5000, 9, torch.float32), update_table(2, **RATES, noise_lr=5e5))
            gradients = some_gradients(run.values, 0)
            gradients.means[::700] = math.nan
            run.update(gradients)
            found.append([*run.values, run.skipped])
    finally:
        torch.set_num_threads(threads)
    assert run.skipped == 8
    for tensors in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(tensors, found[0], strict=True))


def test_a_table_holds_each_number_of_each_step():
    table = update_table(3, **RATES | dict(means_lr=[3.0, 2.0, 1.0]), noise_lr=4.0, betas=(0.5, 0.9), dtype=DOUBLE)
    assert table[:, 0].tolist() == [3, 2, 1] and table[:, 8].tolist() == [4, 4, 4]
    torch.testing.assert_close(table[:, 6:8], torch.tensor([[0.5, 0.1], [0.75, 0.19], [0.875, 0.271]], dtype=DOUBLE))
    with pytest.raises(InputError, match="opacities_lr must be one number or one for each of 3 steps"):
        update_table(3, **RATES | dict(opacities_lr=[1.0, 2.0]))
    with pytest.raises(InputError, match="means_lr must be finite and not negative"):
        update_table(3, **RATES | dict(means_lr=math.nan))


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(step=torch.tensor(2)), r"step must be a row of the table, 0..1, got 2"),
        (dict(step=torch.tensor([0, 1])), r"step must be \[1\]"),
        (dict(skipped=torch.tensor(0, dtype=torch.int32)), "skipped must be torch.int64"),
        (dict(seed=-1), "seed must be"),
        (dict(seen=torch.ones(40)), "seen must be torch.uint8"),
        (dict(table=torch.zeros(2, 10, dtype=DOUBLE)), r"table must be \[2, 11\]"),
        (dict(betas=(0.9, 1.0)), "beta2 must be"),
    ],
)
def test_what_cannot_be_used_is_said(change, message):
    run = Run(make_parameters(), update_table(2, **RATES, dtype=DOUBLE))
    with pytest.raises(InputError, match=message):
        run.update(some_gradients(run.values, 0), **change)


def test_parameters_that_cannot_be_used_are_named():
    run = Run(make_parameters(), update_table(2, **RATES, dtype=DOUBLE))
    gradients = some_gradients(run.values, 0)
    with pytest.raises(InputError, match=r"gradient of scales must be \[40, 3\], got \[40\]"):
        run.update(gradients._replace(scales=gradients.opacities))
    run.first = run.first._replace(means=torch.zeros(3, 40, dtype=DOUBLE).T)
    with pytest.raises(InputError, match="first moments of means is written to and must be contiguous"):
        run.update(gradients)
