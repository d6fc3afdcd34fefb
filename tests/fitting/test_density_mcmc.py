"""Density by MCMC: relocation, sampling, and the number of Gaussians in the end."""

from __future__ import annotations

from fractions import Fraction
from math import comb

import pytest
import torch
from fit_scene import first_state, known_scene, photograph_scene, psnr_db

from lightfield_gs.fitting import density
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer

OPACITIES = [0.005, 0.3, 0.9, 0.9999, 1 - 3e-7]


def relocated(opacity: float, count: int) -> tuple[float, float]:
    """Return the opacity, and the factor of scales."""
    tensors = torch.tensor([opacity], dtype=torch.float64), torch.ones(1, 3, dtype=torch.float64), torch.tensor([count])
    opacities, scales = density.compute_relocation(*tensors)
    return float(opacities), float(scales[0, 0])


@pytest.mark.parametrize("opacity", OPACITIES)
@pytest.mark.parametrize("count", [1, 2, 5, 20, 51])
def test_relocation_is_equation_9(opacity, count):
    found_opacity, found_scale = relocated(opacity, count)
    assert found_opacity == pytest.approx(1 - (1 - opacity) ** (1 / count), rel=1e-9)
    o, roots = Fraction(found_opacity), [Fraction((k + 1) ** -0.5) for k in range(count)]
    # The double sum as it stands, in exact arithmetic
    divisor = sum(comb(i, k) * (-1) ** k * o ** (k + 1) * roots[k] for i in range(count) for k in range(i + 1))
    assert found_scale == pytest.approx(opacity / float(divisor), rel=1e-9)


@pytest.mark.parametrize("opacity", OPACITIES)
@pytest.mark.parametrize("count", [2, 7, 51])
def test_what_is_relocated_covers_as_much_as_before(opacity, count):
    opacity_n, scale = relocated(opacity, count)
    x = torch.linspace(-12, 12, 200_001, dtype=torch.float64)
    before = opacity * torch.exp(-(x**2) / 2)
    after = 1 - (1 - opacity_n * torch.exp(-((x / scale) ** 2) / 2)) ** count
    assert torch.trapezoid(after, x) == pytest.approx(float(torch.trapezoid(before, x)), rel=1e-8)
    assert after[100_000] == pytest.approx(opacity, rel=1e-9)
    assert (after - before).abs().max() < (0.09 if opacity <= 0.9 else 0.28) * opacity  # nowhere very different


def test_sampled_in_proportion_and_never_what_weighs_nothing():
    weights = torch.tensor([0.0, 0.1, 0.0, 0.6, 0.3, 1e-7, 0.0])
    drawn = density.sample_indices(weights, 200_000, seed=3, draw=8)
    assert torch.equal(drawn, density.sample_indices(weights, 200_000, seed=3, draw=8))
    assert not torch.equal(drawn, density.sample_indices(weights, 200_000, seed=3, draw=9))
    fractions = torch.bincount(drawn, minlength=7) / len(drawn)
    assert not fractions[weights == 0].any()
    assert torch.allclose(fractions, weights, atol=4e-3)  # 4 standard deviations


def mcmc_settings(**options) -> FitSettings:
    return FitSettings(density="mcmc", sh_degree=0, **options)


def test_relocation_moves_the_dead_to_the_living():
    settings = mcmc_settings(cap_max=150)
    state = first_state(known_scene(), settings)
    dead = torch.arange(0, 150, 3)
    state.values.logits[dead] = -7
    for moments in (state.first, state.second):
        for tensor in moments:
            tensor.fill_(1)
    state.refresh()
    places = state.values.means.clone()
    changed = density.refine_mcmc(state, settings, step=600)
    assert changed is state and changed.count == 150
    sources = [int((places == mean).all(1).nonzero()) for mean in changed.values.means[dead]]
    assert not set(sources) & set(dead.tolist())
    touched = torch.zeros(150, dtype=torch.bool)
    touched[[*dead.tolist(), *sources]] = True
    for moments in (state.first, state.second):
        for tensor in moments:  # of those that moved and of those that they moved to, as in the paper's program
            assert not tensor[touched].any() and tensor[~touched].eq(1).all()
    for source in set(sources):
        together = 1 - (1 - changed.opacities[[source, *dead[torch.tensor(sources) == source].tolist()]]).prod()
        assert together == pytest.approx(0.5, abs=1e-5)  # that of the source before
    assert torch.equal(changed.scales, changed.values.log_scales.exp())


@pytest.mark.parametrize("steps, start, budget", [(30_000, 150, 40_000), (60, 150, 5_000), (3_000, 7, 31)])
def test_the_number_is_that_of_the_budget_in_the_end(steps, start, budget):
    settings = mcmc_settings(steps=steps, cap_max=budget)
    rounds = [step for step in range(1, steps + 1) if settings.refines_after(step)]
    assert [settings.rounds_from(step) for step in rounds] == list(range(len(rounds), 0, -1))
    count = start
    for step in rounds:
        more = density._target_count(count, settings, step)
        assert count <= more <= budget
        count = more
    assert count == budget


def test_a_fit_comes_nearer_and_repeats_bit_by_bit():
    scene = known_scene()
    images = photograph_scene(scene)
    settings = mcmc_settings(steps=150, cap_max=250, init_scale=0.1)

    def fitted(stops):
        trainer = Trainer(first_state(scene, settings), images, settings)
        for stop in stops:
            trainer.advance(stop)
        return trainer.state

    state = fitted([150])
    assert state.count == 250
    assert psnr_db(state, images) > psnr_db(first_state(scene, settings), images) + 6
    again = fitted([40, 41, 125, 150])
    assert all(torch.equal(one, other) for one, other in zip(state.tensors().values(), again.tensors().values()))
