"""The values that change from step to step, for all steps of a fit, as tensors on its device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.optimizer import update_table
from lightfield_gs.fitting.random import Purpose, uniforms
from lightfield_gs.fitting.settings import FitSettings

_ALWAYS = 1 << 32  # the weight of a photograph that is in every epoch
# The share of the steps after which dropout is largest; the last steps see the whole scene again. Chosen on plush,
# solids-arc-1 and solids-round-1; banana, solids-arc-2 and solids-round-2 had no part (docs/benchmarks.md)
DROPOUT_PEAK = 0.7


@dataclass(frozen=True)
class Schedule:
    """The schedules of a fit. They follow from settings and weights, so a checkpoint need not hold them.

    Attributes:
        order: [steps,V] int64, the photographs of each step.
        numbers: [steps,11], see update_table.
        backgrounds: [steps,3].
        dropouts: [steps], the fraction of Gaussians that a step leaves out; None: no dropout.
    """

    order: Tensor
    numbers: Tensor
    backgrounds: Tensor
    dropouts: Tensor | None

    @classmethod
    def make(
        cls, settings: FitSettings, count: int, device: torch.device | str, weights: Sequence[float] | None = None
    ) -> Schedule:
        """Return the schedules of a fit.

        Args:
            settings: of the fit.
            count: number of photographs.
            device: of the fit.
            weights: of the photographs, 0..1 and the largest 1: the fraction of epochs that have each; None: 1.

        Raises:
            InputError: the weights are others.
        """
        steps, mcmc = settings.steps, settings.density == "mcmc"
        # Learning rates grow with the root of the batch size, since larger batches have less noise
        factor = settings.batch_size**0.5
        explores = (mcmc * (torch.arange(steps) < settings.scaled(settings.noise_stop_iter))).double()
        numbers = update_table(
            steps,
            means_lr=[factor * settings.means_lr_at(step) for step in range(steps)],
            scales_lr=factor * settings.scales_lr,
            quats_lr=factor * settings.quats_lr,
            opacities_lr=factor * settings.opacities_lr,
            sh0_lr=factor * settings.sh0_lr,
            shN_lr=factor * settings.shN_lr,
            noise_lr=explores * settings.noise_lr,
            opacity_reg=explores * settings.opacity_reg,
            scale_reg=explores * settings.scale_reg,
            device=device,
        )
        if settings.background is None:
            backgrounds = uniforms(settings.seed, 0, Purpose.BACKGROUND, 3 * steps).float().view(steps, 3)
        else:
            backgrounds = torch.tensor([settings.background]).expand(steps, 3)
        order = _order_photographs(settings, count, weights)
        most = settings.dropout
        dropouts = (most * _rise_and_fall(torch.arange(steps) / steps)).to(device) if most > 0 else None
        return cls(order.to(device), numbers, backgrounds.contiguous().to(device), dropouts)


def _rise_and_fall(done: Tensor) -> Tensor:
    """Return the share of the largest dropout after shares of the steps, [steps]."""
    return torch.where(done < DROPOUT_PEAK, done / DROPOUT_PEAK, (1 - done) / (1 - DROPOUT_PEAK))


def _order_photographs(settings: FitSettings, count: int, weights: Sequence[float] | None) -> Tensor:
    """Return [steps,V]: every photograph once in each of its epochs, in another order each time."""
    exact = _exact_weights(weights, count)
    wanted = settings.steps * settings.batch_size
    epochs: list[Tensor] = []
    found = 0
    while found < wanted:
        epochs.append(_sample_epoch(settings.seed, len(epochs), exact))
        found += len(epochs[-1])
    return torch.cat(epochs)[:wanted].view(settings.steps, settings.batch_size)


def _sample_epoch(seed: int, epoch: int, weights: Tensor) -> Tensor:
    """Return the photographs of an epoch in their order, each with the exact probability weights / _ALWAYS.

    Systematic sampling (Madow 1949): weights lie end to end, in a random order, on a line. The line has marks at a
    distance of _ALWAYS, the first at a random place. A photograph with a mark in its part of the line is in this epoch.
    So the lengths of epochs differ by one step at most, and the mean gradient over epochs is the gradient of the
    weighted loss. No step is spent on a small weight.
    """
    numbers = uniforms(seed, epoch, Purpose.ORDER, len(weights) + 1)
    order = numbers[:-1].argsort(stable=True)
    ends = weights[order].cumsum(0) + (numbers[-1] * _ALWAYS).long()
    marked = ends // _ALWAYS > (ends - weights[order]) // _ALWAYS
    return order[marked]


def _exact_weights(weights: Sequence[float] | None, count: int) -> Tensor:
    """Return [count] int64, weights in units of 1 / _ALWAYS, whose sums are exact."""
    if weights is None:
        return torch.full((count,), _ALWAYS)
    values = torch.tensor(
        [real_number("weight of a photograph", weight, 0.0, 1.0) for weight in weights], dtype=torch.float64
    )
    if len(values) != count or not bool((values == 1).any()):
        raise InputError(
            f"weights: expected one for each of {count} photographs, the largest of them 1, got {len(values)} of "
            f"{float(values.max()) if len(values) else 0:g} at most"
        )
    return (values * _ALWAYS).round().long()
