"""Adaptive density: clones, splits, pruning, resets, and the moments of all of them."""

from __future__ import annotations

import math

import pytest
import torch
from fit_scene import first_state, known_scene, photograph_scene, psnr_db

from lightfield_gs.fitting.density import DensityStatistics, refine_adaptive, reset_opacities
from lightfield_gs.fitting.optimizer import GaussianState
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.scene.gaussians import Gaussians

EARLY, LATE = 1000, 3100  # before huge ones are removed, and after
SMALL, LARGE, HUGE = 0.005, 0.05, 0.3


def make_state(scales: list[float], opacities: list[float] | None = None) -> GaussianState:
    """Gaussians along x, three times as long along their own z, which is turned to x; with moments of 1."""
    count = len(scales)
    means = torch.stack([torch.arange(count).float(), torch.zeros(count), torch.full((count,), 2.0)], 1)
    sizes = torch.tensor(scales)[:, None] * torch.tensor([[1 / 3, 1 / 3, 1.0]])
    turned = torch.tensor([[1.0, 0.0, 1.0, 0.0]]).repeat(count, 1)  # by 90 degrees about y, not normalized
    opacity = torch.full((count,), 0.5) if opacities is None else torch.tensor(opacities)
    state = GaussianState.start(Gaussians(means, turned, sizes, opacity, torch.rand(count, 4, 3)))
    for moments in (state.first, state.second):
        for tensor in moments:
            tensor.fill_(1)
    return state


def make_settings(**options) -> FitSettings:
    return FitSettings(density="adaptive", **options)


def make_statistics(gradients: list[float], settings: FitSettings) -> DensityStatistics:
    """Return statistics of images: each Gaussian was in four, or in none if its gradient is zero."""
    statistics = DensityStatistics(len(gradients), settings, "cpu")
    statistics.gradients.copy_(4 * torch.tensor(gradients))
    statistics.drawn.copy_(4.0 * (statistics.gradients > 0))
    return statistics


def changed(state: GaussianState, gradients: list[float], step: int = EARLY, **options) -> GaussianState:
    settings = make_settings(**options)
    return refine_adaptive(state, make_statistics(gradients, settings), settings, step)


def test_small_ones_are_cloned_and_large_ones_split():
    before = make_state([SMALL, LARGE, LARGE, SMALL])
    after = changed(before, [3e-4, 1e-4, 3e-4, 0.0])
    assert after.count == 6  # 0, 1, 3; the clone of 0; both parts of 2
    for name, tensor in before.tensors().items():
        assert torch.equal(after.tensors()[name][:3], tensor[[0, 1, 3]]), name
    for one, other in zip(after.values, before.values):
        assert torch.equal(one[3], other[0])
    parts = slice(4, 6)
    assert torch.allclose(after.scales[parts], before.scales[2] / 1.6)
    assert torch.equal(after.opacities[parts], before.opacities[[2, 2]])
    assert torch.equal(after.values.sh[parts], before.values.sh[[2, 2]])
    for moments in (after.first, after.second):
        assert all(not tensor[3:].any() for tensor in moments)


def test_parts_are_drawn_from_the_gaussian_that_they_replace():
    after = changed(make_state([LARGE] * 3000), [1.0] * 3000)
    offsets = after.values.means - torch.cat([make_state([LARGE] * 3000).values.means] * 2)
    deviations = LARGE * torch.tensor([1.0, 1 / 3, 1 / 3])  # z of its own axes lies along x
    assert torch.allclose(offsets.std(0), deviations, rtol=0.04)
    assert (offsets.mean(0).abs() < 4 * deviations / math.sqrt(6000)).all()
    again = changed(make_state([LARGE] * 3000), [1.0] * 3000)
    assert torch.equal(again.values.means, after.values.means)


def test_the_threshold_is_of_means_over_views_and_higher_for_absolute_gradients():
    before = make_state([SMALL, SMALL])
    assert changed(before, [2.1e-4, 1.9e-4]).count == 3
    assert changed(before, [2.1e-4, 1.9e-4], absgrad=True) is before
    assert changed(before, [2.1e-4, 1.9e-4], grow_grad2d=1e-4).count == 4


def test_faint_ones_are_pruned_and_huge_ones_later_if_asked():
    before = make_state([LARGE, LARGE, HUGE], [0.5, 0.004, 0.5])
    pruned = {"prune_scale3d": 0.1}
    assert torch.equal(changed(before, [0.0] * 3, LATE).values.means, before.values.means[[0, 2]])
    assert torch.equal(changed(before, [0.0] * 3, **pruned).values.means, before.values.means[[0, 2]])
    assert torch.equal(changed(before, [0.0] * 3, LATE, **pruned).values.means, before.values.means[:1])
    grown = changed(before, [0.0, 1.0, 1.0], LATE, **pruned)  # neither of the others is worth keeping in parts
    assert torch.equal(grown.values.means, before.values.means[:1])
    faint = make_state([LARGE], [0.004])
    assert changed(faint, [0.0]) is faint  # the last one


def test_never_more_than_the_budget_and_the_strongest_first():
    before = make_state([SMALL, SMALL, LARGE, SMALL, LARGE], [0.5, 0.5, 0.5, 0.5, 0.004])
    after = changed(before, [3e-4, 5e-4, 4e-4, 4e-4, 9e-4], cap_max=6)
    # Room for two beside the four that live: 1, and of 2 and 3, which are equal, the first
    assert after.count == 6
    assert torch.equal(after.values.means[:4], before.values.means[[0, 1, 3, 1]])
    full = make_state([SMALL] * 3)
    assert changed(full, [1.0] * 3, cap_max=3) is full


def test_reset_makes_opacities_small_and_forgets_their_moments():
    state = make_state([SMALL] * 3, [0.9, 0.02, 0.007])
    reset_opacities(state, make_settings())
    assert torch.allclose(state.opacities, torch.tensor([0.01, 0.01, 0.007]))
    assert not state.first.logits.any() and not state.second.logits.any()
    assert state.first.means.all()


@pytest.mark.parametrize(
    "options, resets, sorts",
    [
        ({}, [], [5000, 10000, 15000]),
        ({"reset_every": 3000}, [3000, 6000, 9000, 12000], [5000, 10000, 15000]),
        ({"reset_every": 3000, "steps": 15_000}, [1500, 3000, 4500, 6000], [2500, 5000, 7500]),
        ({"reset_every": 3000, "refine_stop_iter": 12_500}, [3000, 6000, 9000], [5000, 10000, 12500]),
    ],
)
def test_when_opacities_are_reset_and_gaussians_sorted(options, resets, sorts):
    settings = make_settings(**options)
    steps = range(1, settings.steps + 1)
    assert [step for step in steps if settings.resets_after(step)] == resets
    assert [step for step in steps if settings.sorts_after(step)] == sorts
    assert not any(map(FitSettings(reset_every=3000).resets_after, steps))  # mcmc


def test_the_statistics_add_the_gradients_of_each_view_in_halves_of_the_image():
    scene = known_scene()
    images = photograph_scene(scene)
    totals = []
    for count in (1, 2):  # the same six photographs, one or two at once
        names = ("means", "scales", "quats", "opacities", "sh0")
        still = dict.fromkeys([f"{name}_lr" for name in names], 0.0)
        still["dropout"] = 0.0  # each step would leave out others, and steps are as many as the photographs or half
        settings = make_settings(
            steps=6, batch_size=count, sh_degree=0, refine_start_iter=29_999, reset_every=30_000, **still
        )
        trainer = Trainer(first_state(scene, settings), images, settings)
        trainer.advance(6 // count)
        totals.append((trainer.statistics.gradients, trainer.statistics.drawn))
    for one, other in zip(*totals):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-9)
        assert one.any()


def test_a_fit_comes_nearer_and_repeats_bit_by_bit():
    scene = known_scene()
    images = photograph_scene(scene)
    # Few rounds, as in a long fit, and one reset
    settings = make_settings(steps=200, cap_max=250, sh_degree=0, refine_every=2000, reset_every=7500, grow_grad2d=1e-5)

    def fitted(stops):
        trainer = Trainer(first_state(scene, settings), images, settings)
        for stop in stops:
            trainer.advance(stop)
        return trainer.state

    state = fitted([200])
    assert 150 < state.count <= 250
    assert psnr_db(state, images) > psnr_db(first_state(scene, settings), images) + 3
    again = fitted([33, 34, 101, 200])
    assert all(torch.equal(one, other) for one, other in zip(state.tensors().values(), again.tensors().values()))
