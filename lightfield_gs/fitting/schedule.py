"""What changes from step to step, for all steps of a fit at once, in tensors of the device that it runs on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.random import Purpose, uniforms
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.update import update_table

_ALWAYS = 1 << 32  # the share of a photograph that is in every epoch


@dataclass(frozen=True)
class Schedule:
    """order [steps,V] int64: the photographs of each step; numbers [steps,11]: see update_table; backgrounds
    [steps,3]; dropouts [steps]: the share of the Gaussians that a step leaves out, None where none does. All follow
    from the settings and the shares of the photographs: a checkpoint need not hold them."""

    order: Tensor
    numbers: Tensor
    backgrounds: Tensor
    dropouts: Tensor | None

    @classmethod
    def of(
        cls, settings: FitSettings, photographs: int, device: torch.device | str, shares: Sequence[float] | None = None
    ) -> Schedule:
        """For a fit to so many photographs. shares: for each of them, in how many of the epochs it is, 0..1 and the
        largest 1; None: in all."""
        steps, mcmc = settings.steps, settings.density == "mcmc"
        # More views say more surely where to go: rates grow as the root of their number (as for other batches)
        batch = settings.batch_size**0.5
        unsettled = (mcmc * (torch.arange(steps) < settings.scaled(settings.noise_stop_iter))).double()
        numbers = update_table(
            steps,
            means_lr=[batch * settings.means_lr_at(step) for step in range(steps)],
            scales_lr=batch * settings.scales_lr,
            quats_lr=batch * settings.quats_lr,
            opacities_lr=batch * settings.opacities_lr,
            sh0_lr=batch * settings.sh0_lr,
            shN_lr=batch * settings.shN_lr,
            noise_lr=unsettled * settings.noise_lr,
            opacity_reg=unsettled * settings.opacity_reg,
            scale_reg=unsettled * settings.scale_reg,
            device=device,
        )
        if settings.background is None:
            backgrounds = uniforms(settings.seed, 0, Purpose.BACKGROUND, 3 * steps).float().view(steps, 3)
        else:
            backgrounds = torch.tensor([settings.background]).expand(steps, 3)
        order = _order(settings, photographs, shares)
        most = settings.dropout
        dropouts = (most / steps * torch.arange(steps)).to(device) if most > 0 else None
        return cls(order.to(device), numbers, backgrounds.contiguous().to(device), dropouts)


def _order(settings: FitSettings, photographs: int, shares: Sequence[float] | None) -> Tensor:
    """[steps,V]: every photograph once in each epoch that it is in, in another order each time."""
    whole = _whole_numbers(shares, photographs)
    wanted = settings.steps * settings.batch_size
    epochs: list[Tensor] = []
    found = 0
    while found < wanted:
        epochs.append(_epoch(settings.seed, len(epochs), whole))
        found += len(epochs[-1])
    return torch.cat(epochs)[:wanted].view(settings.steps, settings.batch_size)


def _epoch(seed: int, epoch: int, shares: Tensor) -> Tensor:
    """Photographs in the order of an epoch: each with the probability shares / _ALWAYS, and that exactly.

    Systematic sampling (Madow 1949): shares are laid end to end, in a random order, on a line with marks at a distance
    of _ALWAYS, the first at a random place; a photograph is in this epoch if there is a mark in its part of the line.
    So epochs are of one length but for one step, and in the mean over epochs the gradient is that of the loss in which
    each photograph has its share as its weight: no step is spent on a small one.
    """
    numbers = uniforms(seed, epoch, Purpose.ORDER, len(shares) + 1)
    order = numbers[:-1].argsort(stable=True)
    ends = shares[order].cumsum(0) + (numbers[-1] * _ALWAYS).long()
    marked = ends // _ALWAYS > (ends - shares[order]) // _ALWAYS
    return order[marked]


def _whole_numbers(shares: Sequence[float] | None, photographs: int) -> Tensor:
    """[photographs] int64: shares in units of 1 / _ALWAYS, whose sums are exact. Raises InputError."""
    if shares is None:
        return torch.full((photographs,), _ALWAYS)
    values = torch.tensor(
        [real_number("share of a photograph", share, 0.0, 1.0) for share in shares], dtype=torch.float64
    )
    if len(values) != photographs or not bool((values == 1).any()):
        raise InputError(
            f"shares: expected one for each of {photographs} photographs, the largest of them 1, got {len(values)} of "
            f"{float(values.max()) if len(values) else 0:g} at most"
        )
    return (values * _ALWAYS).round().long()
