"""The vision transformer of DINOv2 (Oquab et al. 2023), by the names of its weights."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.photo.depth_models.weights import Weights

PATCH_PX = 14
_HEAD = 64  # channels of an attention head, at every size of the network
_EPS = 1e-6
_OFFSET = 0.1  # patches by which its positions are stretched, as in its training


def features(
    weights: Weights, images: Tensor, layers: Sequence[int], last_eps: float = _EPS
) -> tuple[list[Tensor], Tensor]:
    """Return what some layers see.

    Args:
        weights: Of the transformer.
        images: [B, 3, H, W], normalized; H and W are multiples of PATCH_PX.
        layers: Their numbers, rising.
        last_eps: Epsilon of the norm of what is returned.

    Returns:
        A map [B, C, H / PATCH_PX, W / PATCH_PX] for each of the layers, and the class token [B, C] of the last one.
    """
    patches = weights.at("patch_embed.proj").convolve(images, PATCH_PX)
    size = patches.shape[2:]
    first = weights["cls_token"].expand(len(images), -1, -1)
    x = torch.cat([first, patches.flatten(2).mT], 1) + _positions(weights["pos_embed"], *size)
    maps: list[Tensor] = []
    token = first[:, 0]
    for number in range(max(layers) + 1):
        x = _block(weights.at(f"blocks.{number}"), x)
        if number in layers:
            seen = weights.at("norm").layer_norm(x, last_eps)
            token = seen[:, 0]
            maps.append(seen[:, 1:].mT.unflatten(2, size))
    return maps, token


def _positions(learned: Tensor, rows: int, columns: int) -> Tensor:
    """Return the embeddings of positions [1, 1 + rows columns, C] from those of a square [1, 1 + N N, C]."""
    side = round((learned.shape[1] - 1) ** 0.5)
    if (rows, columns) == (side, side):
        return learned
    square = learned[:, 1:].mT.unflatten(2, (side, side))
    scale = ((rows + _OFFSET) / side, (columns + _OFFSET) / side)
    return torch.cat([learned[:, :1], F.interpolate(square, scale_factor=scale, mode="bicubic").flatten(2).mT], 1)


def _block(weights: Weights, x: Tensor) -> Tensor:
    qkv = weights.at("attn.qkv").linear(weights.at("norm1").layer_norm(x, _EPS))
    query, key, value = qkv.unflatten(2, (3, -1, _HEAD)).permute(2, 0, 3, 1, 4)
    seen = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
    x = x + weights["ls1.gamma"] * weights.at("attn.proj").linear(seen)
    inner = F.gelu(weights.at("mlp.fc1").linear(weights.at("norm2").layer_norm(x, _EPS)))
    return x + weights["ls2.gamma"] * weights.at("mlp.fc2").linear(inner)
