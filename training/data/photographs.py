"""Faults of photographs that renders lack: soft focus, noise, and the outlines of automatic cut-outs.

Only input pictures get them. Targets stay clean, so that the network learns to put such pictures right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class PhotoPlan:
    """Faults of B input pictures; float32 [B] unless stated.

    Attributes:
        blur: Standard deviation of the lens's softness, pixels.
        noise: Standard deviation, of 1.
        outline: Distance of the cut-out's outline from the object's, pixels, negative inside.
        softness: Standard deviation of the outline, pixels, 0 where the outline is left alone.
        backgrounds: [B,3], backgrounds of the photos, which shine through at altered outlines.
        seeds: int64 [B].
    """

    blur: Tensor
    noise: Tensor
    outline: Tensor
    softness: Tensor
    backgrounds: Tensor
    seeds: Tensor


def draw_faults(rng: np.random.Generator, count: int, blur_px: float, noise: float, outline_px: float) -> PhotoPlan:
    """Draw random faults up to the given limits; each leaves half of the pictures as they are."""
    u = rng.random((count, 8))
    strength = np.maximum(0, 2 * u[:, :3] - 1) * (blur_px, noise, outline_px)
    outline = strength[:, 2] * np.where(u[:, 3] < 0.5, -1, 1) * u[:, 4]
    numbers = (strength[:, 0], strength[:, 1], outline, strength[:, 2], u[:, 5:])
    return PhotoPlan(
        *(torch.from_numpy(values.astype(np.float32)) for values in numbers),
        torch.from_numpy(rng.integers(1 << 31, size=count)),
    )


def photographed(images: Tensor, plan: PhotoPlan) -> Tensor:
    """Premultiplied images [B,4,S,S], 0..1, with the faults of the plan."""
    images = _blurred(images, plan.blur)
    colour, alpha = images[:, :3], images[:, 3:]
    outline, softness, noise = (values[:, None, None, None] for values in (plan.outline, plan.softness, plan.noise))
    # A straight edge blurred this way has the value of the distribution function at each distance from it.
    threshold = 0.5 * (1 + torch.erf(-outline / (math.sqrt(2) * softness.clamp_min(1e-3))))
    steepness = (0.6 / threshold.minimum(1 - threshold)).clamp_min(1.5)  # clear of the outline it is 0 and 1
    cut = (0.5 + steepness * (_blurred(alpha, plan.softness) - threshold)).clamp(0, 1)
    behind = (1 - alpha) * plan.backgrounds[:, :, None, None]
    altered = softness > 0
    colour = torch.where(altered, cut * (colour + behind), colour)
    alpha = torch.where(altered, cut, alpha)
    colour = (colour + alpha * noise * _noise(plan.seeds, colour)).clamp_min(0).minimum(alpha)
    return torch.cat([colour, alpha], 1)


def _blurred(images: Tensor, deviation: Tensor) -> Tensor:
    """Images [B,C,S,S] blurred by Gaussians of standard deviations [B], pixels.

    At the border the weights of what lies inside add up to 1: nothing comes in from outside.
    """
    place = torch.arange(images.shape[-1], device=images.device)
    # Below 0.05 pixels nothing of a neighbour is left.
    weights = torch.exp(-0.5 * ((place - place[:, None]) / deviation.clamp_min(0.05)[:, None, None]).square())
    weights = (weights / weights.sum(-1, keepdim=True))[:, None]
    return weights @ images @ weights.mT


def _noise(seeds: Tensor, like: Tensor) -> Tensor:
    """Noise of mean 0 and standard deviation 1, [B,C,H,W]: a hash of seed [B] and place, the same on every device."""
    place = torch.arange(like[0].numel(), device=like.device).view(1, *like.shape[1:])
    # Multiply and fold, twice, modulo 2^64.
    mixed = (seeds[:, None, None, None] << 24) + place
    for factor in (-7046029254386353131, -4658895280553007687):
        mixed = mixed * factor
        mixed = mixed ^ (mixed >> 31)
    uniform = ((mixed & 0xFFFFFF) + (mixed >> 32 & 0xFFFFFF)).float() / (1 << 24)  # two, together 1 +- 1 / sqrt(6)
    return math.sqrt(6) * (uniform - 1)
