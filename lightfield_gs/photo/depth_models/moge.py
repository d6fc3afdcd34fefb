"""MoGe-2 (Wang et al. 2025): distances in metres, the field of view, and the sky."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from scipy.optimize import least_squares
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DepthKind
from lightfield_gs.photo.depth_models import vit
from lightfield_gs.photo.depth_models.model import Pixels, Prediction, normalized, resized, with_sky
from lightfield_gs.photo.depth_models.weights import Weights, WrongWeights, in_float32, read_tensors

_LEVELS = 5
_PATCHES = (1200, 3600)
_NORMS = ("layer_norm", "group_norm")  # of a block, where the configuration does not say
_SAMPLED = 64  # points of a side that the camera is estimated from
_KNOWN = 0.5  # number of the mask from which on a pixel has a distance
_FEWEST = 2  # such points of a camera
_NEAREST = 1e-6  # distance of points that would be behind the camera


class MoGe2:
    """The network in a file model.pt."""

    family = "MoGe-2"
    kind: DepthKind | None = "distance"
    at_once = 1
    never_waits = False

    def __init__(self, path: Path, device: str) -> None:
        stored = read_tensors(path, device)
        config = stored.get("model_config")
        if not isinstance(config, dict) or "neck" not in config:
            raise InputError(f"depth_model=: expected the weights of MoGe-2, got {path}: it has no model_config of it")
        self._config: dict[str, Any] = config
        tensors = in_float32(stored["model"])
        self._weights, self._vit = Weights(tensors), Weights(tensors, "encoder.backbone.")
        self._device = torch.device(device)
        layers = config["encoder"]["intermediate_layers"]
        count = self._vit.count("blocks")
        self._layers = range(count - layers, count) if isinstance(layers, int) else layers

    def shrink(self, pixels: Pixels, shorter_px: int | None = None) -> Pixels:
        """Return the picture as it is: the network has to know its shape."""
        return pixels

    def predict(self, pictures: Sequence[Pixels]) -> list[Prediction]:
        """Return the distances and the focal lengths."""
        return [self._predict_one(picture) for picture in pictures]

    def _predict_one(self, picture: Pixels) -> Prediction:
        height, width = picture.shape[:2]
        patches = max(self._config.get("num_tokens_range", _PATCHES))
        rows, columns = (max(1, round(math.sqrt(patches * ratio))) for ratio in (height / width, width / height))
        seen = resized(picture, rows * vit.PATCH_PX, columns * vit.PATCH_PX, Image.Resampling.BILINEAR)
        maps, token = vit.features(self._vit, normalized([seen], self._device), self._layers)
        projections = self._weights.at("encoder.output_projections")
        coarsest = torch.stack([projections.at(str(number)).convolve(part) for number, part in enumerate(maps)]).sum(0)
        planes = [_view_plane(rows << level, columns << level, height, width, self._device) for level in range(_LEVELS)]
        shared = self._stack("neck", [torch.cat([coarsest, planes[0]], 1), *planes[1:]])
        points = _remapped(self._stack("points_head", shared)[-1][0], self._config.get("remap_output", "linear"))
        is_known = self._stack("mask_head", shared)[-1][0, 0].sigmoid() > _KNOWN
        z, focal = _camera(points, planes[-1][0], is_known)
        if "scale_head" in self._config:
            z = z * self._metres(token)
        # The focal length is in halves of the diagonal
        return with_sky(z, ~is_known, None if focal is None else focal / 2 * math.hypot(width, height) / width)

    def _stack(self, name: str, inputs: list[Tensor]) -> list[Tensor]:
        """Return what a stack of convolutions makes of maps, each twice as large as the one before."""
        weights, config = self._weights.at(name), self._config[name]
        found, x = [], None
        for number, part in enumerate(inputs):
            if "weight" in (enter := weights.at(f"input_blocks.{number}")):
                part = enter.convolve(part)
            x = part if x is None else x + part
            for block in range(weights.count(f"res_blocks.{number}")):
                x = _residual(weights.at(f"res_blocks.{number}.{block}.layers"), x, config)
            leave = weights.at(f"output_blocks.{number}")
            found.append(leave.convolve(x) if "weight" in leave else x)
            if number + 1 < len(inputs):
                kinds = config["resamplers"]
                kind = kinds if isinstance(kinds, str) else kinds[number]
                x = _enlarged(weights.at(f"resamplers.{number}"), x, kind)
        return found

    def _metres(self, token: Tensor) -> float:
        """Return the metres of a unit, by the class token [1, C]."""
        layers, count = self._weights.at("scale_head"), self._weights.count("scale_head")
        for number in range(0, count, 2):
            token = layers.at(str(number)).linear(token)
            token = F.relu(token) if number + 1 < count else token
        return float(token.exp())


def _view_plane(rows: int, columns: int, height: int, width: int, device: torch.device) -> Tensor:
    """Return the places of pixels [1, 2, rows, columns], x and y from the middle, in halves of the diagonal."""
    diagonal = math.hypot(height, width)
    y, x = (
        (torch.arange(count, device=device) * 2 + 1 - count) / count * (side / diagonal)
        for count, side in ((rows, height), (columns, width))
    )
    return torch.stack([x.expand(rows, -1), y[:, None].expand(-1, columns)])[None]


def _residual(weights: Weights, x: Tensor, config: dict[str, Any]) -> Tensor:
    """Return x after two convolutions, each after a norm and a ReLU, added to it."""
    if config.get("activation", "relu") != "relu":
        raise WrongWeights(f"they have the activation {config['activation']}, and this reader knows relu")
    inner = x
    for number, norm in enumerate(("res_block_in_norm", "res_block_hidden_norm")):
        kind = config.get(norm, _NORMS[number])
        if kind in ("layer_norm", "group_norm"):
            groups = 1 if kind == "layer_norm" else inner.shape[1] // 32
            scale = weights.at(str(3 * number))
            inner = F.group_norm(inner, groups, scale["weight"], scale["bias"])
        elif kind != "none":
            raise WrongWeights(f"they have the norm {kind}, and this reader knows layer_norm, group_norm and none")
        inner = weights.at(str(3 * number + 2)).convolve(F.relu(inner), mode="replicate")
    return x + inner


def _enlarged(weights: Weights, x: Tensor, kind: str) -> Tensor:
    """Return a map twice as large."""
    if kind == "conv_transpose":
        x = weights.at("0").enlarge(x)
    elif kind == "bilinear":
        x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
    else:
        raise WrongWeights(f"they have the resampler {kind}, and this reader knows conv_transpose and bilinear")
    return weights.at("1").convolve(x, mode="replicate")


def _remapped(points: Tensor, kind: str) -> Tensor:
    """Return points [3, h, w] of the network's last function."""
    if kind == "exp":
        return torch.cat([points[:2] * points[2:].exp(), points[2:].exp()])
    if kind != "linear":
        raise WrongWeights(f"they have points by {kind}, and this reader knows exp and linear")
    return points


def _camera(points: Tensor, plane: Tensor, is_known: Tensor) -> tuple[Tensor, float | None]:
    """Return distances z [h, w], and the focal length in halves of the diagonal, None where nothing tells it.

    The network's z lacks an offset. The offset and the focal length f are those by which f (x, y) / z comes closest to
    the places of the pixels.

    Args:
        points: [3, h, w], x, y and z.
        plane: [2, h, w], places of the pixels.
        is_known: bool [h, w].
    """
    maps = torch.cat([points, plane, is_known[None].to(points)])[None]
    few = F.interpolate(maps, (_SAMPLED, _SAMPLED), mode="nearest")[0].double().cpu().numpy()
    across, z, places = few[:2, few[5] > 0], few[2, few[5] > 0], few[3:5, few[5] > 0]
    if z.size < _FEWEST:
        return points[2], None

    def focal(seen: np.ndarray) -> float:
        return float((seen * places).sum() / np.square(seen).sum())

    def errors(offset: np.ndarray) -> np.ndarray:
        seen = across / (z + offset)
        return (focal(seen) * seen - places).ravel()

    offset = float(least_squares(errors, 0.0, ftol=1e-3, method="lm").x[0])
    return (points[2] + offset).clamp_min(_NEAREST), focal(across / (z + offset))
