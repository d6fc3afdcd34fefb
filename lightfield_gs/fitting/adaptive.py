"""Adaptive density (Kerbl et al. 2023, section 5): Gaussians that the loss pulls about are cloned or split, faint and
huge ones pruned, and opacities now and then reset.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lightfield_gs.base.harmonics import rotations
from lightfield_gs.fitting.fields import Fields
from lightfield_gs.fitting.random import Purpose, normals
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.tally import Tally

_PARTS, _SHRINK = 2, 1.6  # what is split becomes two, of scales so many times smaller
_GROW, _GROW_ABSOLUTE = 2e-4, 6e-4  # gradients; absolute ones: as in gsplat


def change(fields: Fields, tally: Tally, settings: FitSettings, step: int) -> Fields:
    """The fields after a round, once `step` steps are done; the same ones where nothing changed.

    What is kept stays in its order; behind it stand clones, then the first and the second parts of what was split, with
    moments of zero. No more than settings.cap_max in all: where the gradients of more would let them grow, those of
    the largest do. A scene of which nothing would be left stays as it is.
    """
    largest, gradients = fields.scales.amax(1), tally.gradients / tally.drawn.clamp_min(1)
    small = largest <= settings.grow_scale3d
    # Before the first reset what is huge may only have found no smaller ones yet
    most = settings.prune_scale3d if step > settings.scaled(settings.reset_every) else math.inf
    alive = fields.opacities >= settings.min_opacity
    fits_whole, fits_split = alive & (largest <= most), alive & ~small & (largest / _SHRINK <= most)
    wanting = (gradients >= _threshold(settings)) & torch.where(small, fits_whole, fits_split)
    room = settings.cap_max - int((fits_whole | wanting).sum())
    grown = wanting & _strongest(torch.where(wanting, gradients, -1), room)
    kept = fits_whole & ~(grown & ~small)
    clones, split = (grown & small).nonzero()[:, 0], (grown & ~small).nonzero()[:, 0]
    rows = torch.cat([kept.nonzero()[:, 0], clones, *[split] * _PARTS])
    if len(rows) == 0 or (len(rows) == fields.count and bool(kept.all())):
        return fields
    changed = fields.changed(lambda tensor: tensor[rows])
    _forget(changed, int(kept.sum()))
    _split(changed, _PARTS * len(split), settings.seed, step)
    return changed


def reset(fields: Fields, settings: FitSettings) -> None:
    """Makes every opacity at most twice what is pruned, in place, so that what the photographs do not ask for dies."""
    most = 2 * settings.min_opacity
    fields.values.logits.clamp_(max=math.log(most / (1 - most)))
    fields.first.logits.zero_()
    fields.second.logits.zero_()
    fields.renew()


def _threshold(settings: FitSettings) -> float:
    """The mean gradient from which on Gaussians grow, in halves of the image."""
    if settings.grow_grad2d is not None:
        return settings.grow_grad2d
    return _GROW_ABSOLUTE if settings.absgrad else _GROW


def _strongest(numbers: Tensor, count: int) -> Tensor:
    """[N] bool: the `count` largest of the numbers [N]; of equal ones those that come first."""
    found = torch.zeros_like(numbers, dtype=torch.bool)
    found[numbers.argsort(descending=True, stable=True)[: max(count, 0)]] = True
    return found


def _forget(fields: Fields, kept: int) -> None:
    """Sets the moments of all behind the first `kept` to zero."""
    for moments in (fields.first, fields.second):
        for tensor in moments:
            tensor[kept:] = 0


def _split(fields: Fields, count: int, seed: int, step: int) -> None:
    """Moves the last `count` to places drawn from what they are copies of, and shrinks them."""
    parts, values = slice(fields.count - count, None), fields.values
    z = normals(seed, step, Purpose.DENSITY, 3 * count, values.means.dtype, values.means.device).view(count, 3)
    along = fields.scales[parts] * z
    values.means[parts] += (rotations(values.quaternions[parts]) @ along[:, :, None])[:, :, 0]
    values.log_scales[parts] -= math.log(_SHRINK)
    fields.renew()
