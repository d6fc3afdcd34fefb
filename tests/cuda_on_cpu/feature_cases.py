"""Features, normals and median depths of two scenes before three cameras, and the gradients of a loss on them."""

from __future__ import annotations

from typing import Any

import torch
from rasterizer_cases import dense_views
from torch import Tensor

import lightfield_gs as lf
from lightfield_gs.bench.scenes import sheet, with_harmonics

CHANNELS = (3, 12, 16, 36, 37)  # few, one chunk and several, by fours and one by one
VIEWS = 3


def step(dtype: torch.dtype, channels: int, own: bool, eps2d: float) -> dict[str, Tensor]:
    """own: whether each camera has its own features; eps2d: of render, by torch where it is not 0.3."""
    scenes = [with_harmonics(sheet(16, seed), 1) for seed in range(2)]
    fields = {f: torch.stack([s.fields()[f] for s in scenes]).to(dtype).requires_grad_() for f in scenes[0].fields()}
    pose, numbers, limits = (t.to(dtype) for t in dense_views(1, VIEWS, 45, 21))
    cameras = lf.Cameras(pose[0], numbers[0, :, :2], numbers[0, :, 2:], 45, 21, limits[0])
    random = torch.Generator().manual_seed(channels)
    count = scenes[0].count
    features = torch.rand(2, *([VIEWS] if own else []), count, channels, generator=random)
    features = features.to(dtype).requires_grad_()
    screen = torch.zeros(2, VIEWS, count, 2, dtype=dtype, requires_grad=True)
    options: dict[str, Any] = dict(
        normals=True, median_depth=True, depth=True, screen=screen, features=features, eps2d=eps2d
    )
    drawn = lf.render(lf.Gaussians(**fields), cameras, **options)
    outputs = {name: t for name, t in drawn.named().items() if t is not None}
    loss = sum((t * torch.randn(t.shape, generator=random).to(t)).sum() for t in outputs.values() if t.requires_grad)
    leaves = {**fields, "g_features": features, "screen": screen}
    gradients = torch.autograd.grad(loss, list(leaves.values()))
    return {name: t.detach() for name, t in (*outputs.items(), *zip((f"gradient of {n}" for n in leaves), gradients))}


def steps(dtype: torch.dtype) -> list[dict[str, Tensor]]:
    return [
        step(dtype, channels, own, 0.5 if channels == 12 else 0.3) for channels in CHANNELS for own in (False, True)
    ]
