"""The head of dense predictions (Ranftl et al. 2021) of the Depth Anything family, by the names of its weights."""

from __future__ import annotations

from collections.abc import Sequence

import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.photo.depth_models.weights import Weights


def level(weights: Weights, number: int, features: Tensor) -> Tensor:
    """Return the features [B, C, h, w] of one of four layers at its level: 4, 2, 1 and 1/2 of their size."""
    x = weights.at(f"projects.{number}").convolve(features)
    resize = weights.at(f"resize_layers.{number}")
    if number == 3:
        return resize.convolve(x, stride=2)
    return x if number == 2 else resize.enlarge(x)


def beside(weights: Weights, number: int, x: Tensor) -> Tensor:
    """Return a level as it enters the fusion."""
    return weights.at(f"scratch.layer{number + 1}_rn").convolve(x)


def fuse(weights: Weights, number: int, below: Tensor | None, own: Tensor, size: Sequence[int] | None) -> Tensor:
    """Return a level fused with the one below it.

    Args:
        weights: Of the head.
        number: Of the level.
        below: The fused level below; None for the lowest.
        own: What `beside` returns.
        size: Height and width of the level above; None: twice its own.
    """
    part = weights.at(f"scratch.refinenet{number + 1}")
    x = own if below is None else below + _residual(part.at("resConfUnit1"), own)
    x = _residual(part.at("resConfUnit2"), x)
    target = [2 * side for side in x.shape[2:]] if size is None else list(size)
    return part.at("out_conv").convolve(F.interpolate(x, target, mode="bilinear", align_corners=True))


def fused_levels(weights: Weights, levels: list[Tensor], below: Tensor | None = None) -> Tensor:
    """Return levels, from the finest on, fused into the finest; `below`: what the coarser ones fused to."""
    entering = [beside(weights, number, x) for number, x in enumerate(levels)]
    for number in range(len(levels) - 1, -1, -1):
        above = entering[number - 1].shape[2:] if number else None
        below = fuse(weights, number, below, entering[number], above)
    assert below is not None
    return below


def finest(weights: Weights, fused: Tensor, size: tuple[int, int]) -> Tensor:
    """Return the finest level at the size of the picture."""
    x = weights.at("scratch.output_conv1").convolve(fused)
    return F.interpolate(x, size, mode="bilinear", align_corners=True)


def output(weights: Weights, name: str, x: Tensor) -> Tensor:
    """Return the numbers [B, H, W] of one of the outputs, before its last function."""
    head = weights.at(f"scratch.{name}")
    return head.at("2").convolve(F.relu(head.at("0").convolve(x)))[:, 0]


def _residual(weights: Weights, x: Tensor) -> Tensor:
    inner = weights.at("conv1").convolve(F.relu(x))
    return x + weights.at("conv2").convolve(F.relu(inner))
