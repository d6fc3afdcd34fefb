"""Depth Anything 3 for single pictures (Lin et al. 2025): distances without a unit, and the sky."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import torch

from lightfield_gs.base.options import DepthKind
from lightfield_gs.photo.depth_models import dpt, vit
from lightfield_gs.photo.depth_models.model import Pixels, Prediction, normalized, resized, with_sky
from lightfield_gs.photo.depth_models.weights import Weights, in_float32, read_tensors

_LONGER_PX = 504  # side of the picture in its training
_LAYERS = (4, 11, 17, 23)  # of the large network, where its configuration does not say
_SKY = 0.3  # number from which on a pixel is sky
_LAST_EPS = 1e-5


class DepthAnything3:
    """The network in a folder with config.json and model.safetensors."""

    family = "Depth Anything 3 for single pictures (DA3MONO-LARGE)"
    kind: DepthKind | None = "distance"
    at_once = 1
    never_waits = False

    def __init__(self, folder: Path, device: str) -> None:
        tensors = in_float32(read_tensors(next(folder.glob("*.safetensors")), device))
        self._vit, self._head = Weights(tensors, "model.backbone.pretrained."), Weights(tensors, "model.head.")
        self._device = torch.device(device)
        facts = json.loads((folder / "config.json").read_text())
        self._layers = facts.get("config", {}).get("net", {}).get("out_layers", _LAYERS)

    def shrink(self, pixels: Pixels, shorter_px: int | None = None) -> Pixels:
        """See DepthModel."""
        factor = _LONGER_PX / max(pixels.shape[:2])
        if shorter_px is not None:
            factor = min(factor, shorter_px / min(pixels.shape[:2]))
        height, width = (
            max(vit.PATCH_PX, vit.PATCH_PX * round(factor * side / vit.PATCH_PX)) for side in pixels.shape[:2]
        )
        return resized(pixels, height, width)

    def predict(self, pictures: Sequence[Pixels]) -> list[Prediction]:
        """Return the distances, the sky behind everything."""
        return [self._predict_one(picture) for picture in pictures]

    def _predict_one(self, picture: Pixels) -> Prediction:
        maps, _ = vit.features(self._vit, normalized([picture], self._device), self._layers, _LAST_EPS)
        levels = [dpt.level(self._head, number, seen) for number, seen in enumerate(maps)]
        x = dpt.finest(self._head, dpt.fused_levels(self._head, levels), (picture.shape[0], picture.shape[1]))
        distances = dpt.output(self._head, "output_conv2", x)[0].exp()
        sky = dpt.output(self._head, "sky_output_conv2", x)[0]
        return with_sky(distances, sky >= _SKY)
