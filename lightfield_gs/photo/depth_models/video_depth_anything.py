"""Video Depth Anything (Chen et al. 2025): disparities of pictures in a row, which see each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.base.options import DepthKind
from lightfield_gs.photo.depth_models import dpt, vit
from lightfield_gs.photo.depth_models.model import Pixels, Prediction, normalized, resized
from lightfield_gs.photo.depth_models.weights import Weights, in_float32, read_tensors

_SHORTER_PX = 518
_WIDEST = 1.777  # aspect ratio from which on the picture is made smaller, so that it has no more patches
_HEADS, _GROUPS = 8, 32  # of its attention in time
_LAYERS = {12: (2, 5, 8, 11), 24: (4, 11, 17, 23)}  # by the number of its blocks


class VideoDepthAnything:
    """The network in a file of weights, .pth."""

    family = "Video Depth Anything"
    at_once = 32
    never_waits = False

    def __init__(self, path: Path, device: str) -> None:
        tensors = in_float32(read_tensors(path, device))
        self.kind: DepthKind | None = "distance" if path.name.startswith("metric") else "disparity"
        self._vit, self._head = Weights(tensors, "pretrained."), Weights(tensors, "head.")
        self._device = torch.device(device)
        depth = self._vit.count("blocks")
        self._layers = _LAYERS.get(depth) or [(number + 1) * depth // 4 - 1 for number in range(4)]

    def shrink(self, pixels: Pixels, shorter_px: int | None = None) -> Pixels:
        """See DepthModel."""
        height, width = pixels.shape[:2]
        ratio = max(height, width) / min(height, width)
        shorter = min(_SHORTER_PX * min(1.0, _WIDEST / ratio), shorter_px or math.inf)
        factor = shorter / min(height, width)
        rows, columns = (max(1, round(factor * side / vit.PATCH_PX)) for side in (height, width))
        return resized(pixels, vit.PATCH_PX * rows, vit.PATCH_PX * columns)

    def predict(self, pictures: Sequence[Pixels]) -> list[Prediction]:
        """Return the numbers of pictures that follow each other."""
        size = pictures[0].shape[0], pictures[0].shape[1]
        seen = [vit.features(self._vit, normalized([picture], self._device), self._layers)[0] for picture in pictures]
        # The coarse half sees all pictures, the fine half one at a time
        coarse = [
            self._in_time(number - 2, torch.cat([dpt.level(self._head, number, maps[number]) for maps in seen]))
            for number in (2, 3)
        ]
        third, fourth = (dpt.beside(self._head, number, x) for number, x in zip((2, 3), coarse))
        below = self._in_time(2, dpt.fuse(self._head, 3, None, fourth, third.shape[2:]))
        second = (2 * third.shape[2], 2 * third.shape[3])
        below = self._in_time(3, dpt.fuse(self._head, 2, below, third, second))
        found = []
        for number, maps in enumerate(seen):
            levels = [dpt.level(self._head, part, maps[part]) for part in (0, 1)]
            fused = dpt.fused_levels(self._head, levels, below[number : number + 1])
            values = dpt.output(self._head, "output_conv2", dpt.finest(self._head, fused, size))
            found.append(Prediction(F.relu(values[0])))
        return found

    def _in_time(self, number: int, x: Tensor) -> Tensor:
        """Return features [T, C, h, w], each of which has seen those of the same place in all pictures."""
        weights = self._head.at(f"motion_modules.{number}.temporal_transformer")
        size = x.shape[2:]
        norm = weights.at("norm")
        tokens = F.group_norm(x, _GROUPS, norm["weight"], norm["bias"], 1e-6).flatten(2).permute(2, 0, 1)
        tokens = weights.at("proj_in").linear(tokens)
        for block in range(weights.count("transformer_blocks")):
            tokens = _block(weights.at(f"transformer_blocks.{block}"), tokens)
        return x + weights.at("proj_out").linear(tokens).permute(1, 2, 0).unflatten(2, size)


def _block(weights: Weights, tokens: Tensor) -> Tensor:
    """Return tokens [places, T, C] after attention in time and a gated layer."""
    for number in range(weights.count("attention_blocks")):
        attention = weights.at(f"attention_blocks.{number}")
        x = weights.at(f"norms.{number}").layer_norm(tokens, 1e-5)
        x = x + attention["pos_encoder.pe"][:, : x.shape[1]]
        query, key, value = (
            attention.at(f"to_{name}").linear(x).unflatten(2, (_HEADS, -1)).transpose(1, 2) for name in "qkv"
        )
        seen = F.scaled_dot_product_attention(query, key, value).transpose(1, 2).flatten(2)
        tokens = tokens + attention.at("to_out.0").linear(seen)
    inner, gate = weights.at("ff.net.0.proj").linear(weights.at("ff_norm").layer_norm(tokens, 1e-5)).chunk(2, 2)
    return tokens + weights.at("ff.net.2").linear(inner * F.gelu(gate))
