"""Faults of photographs and of estimated depths, which compositions lack: softness, noise, JPEG, smoothed edges."""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

_BLOCK = 8  # pixels of a JPEG block
_SPARED = 0.4  # fraction of the pictures without a fault, for each fault by itself
_MOST_BLUR_PX, _MOST_NOISE = 1.0, 0.02
_MOST_STEP = 0.12  # coarsest step of the lowest frequencies of a block, of 1: quality 30 or so
_MOST_SOFT_PX = 1.5  # standard deviation of smoothed depth edges
_MOST_SHIFT_PX = 1.0  # of depth edges from the picture's
_MOST_WAVE, _MOST_GRAIN = 0.03, 0.002  # relative errors of disparity: smooth ones, and grain


def soften(images: Tensor, deviation_px: Tensor) -> Tensor:
    """Return images [B,C,H,W], or maps, blurred by Gaussians of standard deviations [B], pixels."""
    reach = torch.arange(-4, 5, device=images.device)
    weights = torch.exp(-0.5 * (reach / deviation_px.clamp_min(0.05)[:, None]).square())
    weights = weights / weights.sum(1, keepdim=True)
    count, channels = images.shape[:2]
    flat = images.reshape(1, count * channels, *images.shape[2:])
    kernel = weights.repeat_interleave(channels, 0)[:, None]
    flat = F.conv2d(F.pad(flat, (4, 4, 0, 0), mode="replicate"), kernel[:, :, None], groups=count * channels)
    flat = F.conv2d(F.pad(flat, (0, 0, 4, 4), mode="replicate"), kernel[..., None], groups=count * channels)
    return flat.view_as(images)


def draw_softness(rng: np.random.Generator, count: int, most_px: float = _MOST_BLUR_PX) -> Tensor:
    """Return standard deviations [count], 0 for some."""
    return _strength(rng, count, most_px)


def photographed(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Return pictures [B,3,H,W], 0..1, with the noise of a sensor and the blocks of JPEG."""
    noise, step = (_strength(rng, len(images), most).to(images) for most in (_MOST_NOISE, _MOST_STEP))
    grain = _normal(rng, images)
    noisy = images + noise[:, None, None, None] * grain
    return torch.where((step > 0)[:, None, None, None], _blocks_rounded(noisy, step), noisy).clamp(0, 1)


def _blocks_rounded(images: Tensor, step: Tensor) -> Tensor:
    """Return images whose cosine transforms, block by block, are rounded to steps [B]; high frequencies to coarser."""
    height, width = images.shape[2:]
    padding = (0, -width % _BLOCK, 0, -height % _BLOCK)
    padded = F.pad(images, padding, mode="replicate")
    blocks = padded.unfold(2, _BLOCK, _BLOCK).unfold(3, _BLOCK, _BLOCK)
    number = torch.arange(_BLOCK, device=images.device)
    transform = torch.cos(math.pi / _BLOCK * (number + 0.5) * number[:, None]) * math.sqrt(2 / _BLOCK)
    transform[0] /= math.sqrt(2)
    coefficients = transform @ blocks @ transform.T
    steps = step[:, None, None, None, None, None] * (1 + 0.5 * (number[:, None] + number))
    blocks = transform.T @ ((coefficients / steps.clamp_min(1e-6)).round() * steps) @ transform
    return blocks.permute(0, 1, 2, 4, 3, 5).reshape(padded.shape)[..., :height, :width]


def estimated(depth: Tensor, rng: np.random.Generator) -> Tensor:
    """Return depths [B,H,W] as a network estimates them: soft and misplaced edges, smooth errors, and grain."""
    count, size = len(depth), depth.shape[1:]
    soft, wave, grain = (_strength(rng, count, most).to(depth) for most in (_MOST_SOFT_PX, _MOST_WAVE, _MOST_GRAIN))
    disparity = soften((1 / depth)[:, None], soft)
    coarse = torch.from_numpy(rng.uniform(-1, 1, (count, 2, 24, 24)).astype(np.float32)).to(depth)
    shift = _strength(rng, count, _MOST_SHIFT_PX).to(depth)[:, None, None, None]
    fine = F.interpolate(coarse, size=size, mode="bicubic", align_corners=False)
    middle = torch.tensor(size[::-1], device=depth.device)
    grid = torch.stack(torch.meshgrid(*(torch.arange(n, device=depth.device) + 0.5 for n in size), indexing="ij"), -1)
    place = 2 * (grid.flip(-1) + (shift * fine).movedim(1, 3)) / middle - 1
    moved = F.grid_sample(disparity, place, mode="nearest", padding_mode="border", align_corners=False)
    smooth = torch.from_numpy(rng.uniform(-1, 1, (count, 1, 5, 5)).astype(np.float32)).to(depth)
    smooth = F.interpolate(smooth, size=size, mode="bicubic", align_corners=False)
    noise = _normal(rng, disparity)
    factor = wave[:, None, None, None] * smooth + grain[:, None, None, None] * noise
    return (1 / (moved * (1 + factor).clamp_min(0.5)))[:, 0]


def _normal(rng: np.random.Generator, like: Tensor) -> Tensor:
    """Return normal numbers, made on the device."""
    generator = torch.Generator(like.device).manual_seed(int(rng.integers(1 << 31)))
    return torch.randn(like.shape, generator=generator, device=like.device, dtype=like.dtype)


def _strength(rng: np.random.Generator, count: int, most: float) -> Tensor:
    """Return strengths [count] of a fault, 0 for some."""
    u = rng.random((2, count))
    return torch.from_numpy(np.where(u[0] < _SPARED, 0, most * u[1]).astype(np.float32))
