"""Density by Markov chain Monte Carlo (Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", 2024).

Dead Gaussians move to places of live ones, and their number grows by a share until it is that of the budget. Several at
one place share what one was: their opacities and scales are set so that together they look nearly as it did.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lightfield_gs.fitting.fields import Fields
from lightfield_gs.fitting.random import Purpose, uniforms
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.update import MOST_LOGIT, RawFields

_MOST_SHARED = 51  # how many share a place at most, as far as the formula is concerned
_WEIGHT_STEPS = 2**31  # weights are whole numbers, for sums of these are the same in any order


def change(fields: Fields, settings: FitSettings, step: int) -> Fields:
    """The fields after a round of moving and adding, and of the number that is due; the same ones where that did not
    grow. step: how many are done; random numbers follow from it and settings.seed."""
    dead = (fields.opacities <= settings.min_opacity).nonzero()[:, 0]
    if 0 < len(dead) < fields.count:
        weights = fields.opacities.clone()
        weights[dead] = 0
        sources = sampled(weights, len(dead), settings.seed, 2 * step)
        _share(fields, sources, settings.min_opacity)
        _copy(fields, sources, dead)
    wanted = _wanted(fields.count, settings, step)
    if wanted == fields.count:
        return fields
    sources = sampled(fields.opacities, wanted - fields.count, settings.seed, 2 * step + 1)
    _share(fields, sources, settings.min_opacity)
    return _appended(fields, sources)


def _wanted(count: int, settings: FitSettings, step: int) -> int:
    """How many there are after the round at `step`: more by settings.growth, or by as much as it takes to reach
    settings.cap_max in the rounds that are left, where these are few."""
    needed = count * (settings.cap_max / count) ** (1 / max(1, settings.rounds_from(step)))
    return max(count, min(settings.cap_max, max(int(count * settings.growth), math.ceil(needed))))


def sampled(weights: Tensor, count: int, seed: int, draw: int) -> Tensor:
    """[count] indices, with repetition, each with a probability in proportion to its weight [N] in 0..1.

    The same on any device: weights are rounded to whole numbers before they are summed up.
    """
    ends = (weights.double() * _WEIGHT_STEPS).long().cumsum(0)
    places = (uniforms(seed, draw, Purpose.DENSITY, count, weights.device) * ends[-1]).long()
    # A product that was rounded up to the end would be nobody's place
    return torch.searchsorted(ends, torch.minimum(places, ends[-1] - 1), right=True)


def shared(opacities: Tensor, scales: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor]:
    """Opacities [P] and scales [P,3] of each of `numbers` [P] Gaussians that together replace one.

    Equation 9 of the paper: with n of them, opacity_n = 1 - (1 - opacity)^(1/n), and scale_n = scale opacity / D,
    D = sum over i = 1..n and k = 0..i-1 of binomial(i-1, k) (-1)^k opacity_n^(k+1) / sqrt(k+1). All float64.
    """
    n = numbers.clamp(1, _MOST_SHARED)
    opacity = -torch.expm1(torch.log1p(-opacities) / n)
    # The sum over i of binomial(i-1, k) for i = 1..n is binomial(n, k+1): one sum in place of two. Its terms alternate,
    # but opacity_n falls with n, so that they stay small: the sum is good to 1e-11 up to the largest opacity there is.
    k = torch.arange(_MOST_SHARED, device=n.device, dtype=torch.float64)
    binomials = _binomials(n.device)[n]  # [P, k] of (n, k + 1)
    terms = binomials * (-1) ** k / torch.sqrt(k + 1) * opacity[:, None] ** (k + 1)
    return opacity, scales * (opacities / terms.sum(1))[:, None]


def _binomials(device: torch.device) -> Tensor:
    """[n, k] float64: binomial(n, k + 1), for n up to _MOST_SHARED and k below it."""
    rows = [[math.comb(n, k + 1) for k in range(_MOST_SHARED)] for n in range(_MOST_SHARED + 1)]
    return torch.tensor(rows, dtype=torch.float64, device=device)


def _share(fields: Fields, sources: Tensor, min_opacity: float) -> None:
    """Makes each of `sources` what it is once it shares its place with as many others as it is named."""
    numbers = torch.bincount(sources, minlength=fields.count) + 1
    places = (numbers > 1).nonzero()[:, 0]
    opacities, scales = shared(fields.opacities[places].double(), fields.scales[places].double(), numbers[places])
    # A place that many share must not die of it at once
    opacities = opacities.clamp(min_opacity, 1 - 1e-7)
    fields.values.logits[places] = torch.logit(opacities).clamp(-MOST_LOGIT, MOST_LOGIT).float()
    fields.values.log_scales[places] = scales.log().float()
    for moments in (fields.first, fields.second):
        for tensor in moments:
            tensor[places] = 0
    fields.renew()


def _copy(fields: Fields, sources: Tensor, targets: Tensor) -> None:
    """Makes each of `targets` like its source, with moments of zero."""
    for tensor in fields.values:
        tensor[targets] = tensor[sources]
    for moments in (fields.first, fields.second):
        for tensor in moments:
            tensor[targets] = 0
    fields.renew()


def _appended(fields: Fields, sources: Tensor) -> Fields:
    """The fields with copies of `sources` behind them, of moments zero."""
    values = RawFields(*(torch.cat([tensor, tensor[sources]]) for tensor in fields.values))
    first, second = (
        RawFields(*(torch.cat([t, t.new_zeros(len(sources), *t.shape[1:])]) for t in moments))
        for moments in (fields.first, fields.second)
    )
    scales, opacities = (torch.cat([t, t[sources]]) for t in (fields.scales, fields.opacities))
    return Fields(values, first, second, scales, opacities)
