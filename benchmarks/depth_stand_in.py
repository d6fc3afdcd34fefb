"""A network of the size of Depth Anything Small with random weights: it takes as long, and knows nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from lightfield_gs.base.options import DepthKind
from lightfield_gs.photo.depth_models.model import Pixels, Prediction, normalized, resized

_PATCH_PX, _SHORTER_PX = 14, 518
_CHANNELS, _HEADS, _BLOCKS, _FEATURES = 384, 6, 12, 64


class _Taps(NamedTuple):
    """The blocks whose tokens the head takes, and the sizes of its maps by the patches'."""

    blocks: tuple[int, ...] = (2, 5, 8, 11)
    scales: tuple[float, ...] = (4.0, 2.0, 1.0, 0.5)


_TAPS = _Taps()


class _Network(nn.Module):
    """A vision transformer with a head that fuses four of its levels (as of Ranftl et al., 2021)."""

    def __init__(self) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, _CHANNELS, _PATCH_PX, _PATCH_PX)
        self.blocks = nn.ModuleList(
            nn.TransformerEncoderLayer(
                _CHANNELS, _HEADS, 4 * _CHANNELS, 0.0, activation="gelu", batch_first=True, norm_first=True
            )
            for _ in range(_BLOCKS)
        )
        self.projections = nn.ModuleList(nn.Conv2d(_CHANNELS, _FEATURES, 1) for _ in _TAPS.blocks)
        self.units = nn.ModuleList(
            nn.Sequential(*(nn.Conv2d(_FEATURES, _FEATURES, 3, padding=1) for _ in range(4))) for _ in _TAPS.blocks
        )
        self.head = nn.Sequential(nn.Conv2d(_FEATURES, 32, 3, padding=1), nn.ReLU(), nn.Conv2d(32, 1, 1))

    def forward(self, images: Tensor) -> Tensor:
        x = self.patches(images)
        rows, columns = x.shape[2:]
        tokens, levels = x.flatten(2).mT, []
        for number, block in enumerate(self.blocks):
            tokens = block(tokens)
            if number in _TAPS.blocks:
                levels.append(tokens.mT.unflatten(2, (rows, columns)))
        fused: Tensor | None = None
        for level, project, unit, scale in reversed([*zip(levels, self.projections, self.units, _TAPS.scales)]):
            size = [max(1, int(scale * side)) for side in (rows, columns)]
            own = interpolate(project(level), size=size, mode="bilinear", align_corners=False)
            if fused is not None:
                own = own + interpolate(fused, size=size, mode="bilinear", align_corners=False)
            fused = unit(own)
        assert fused is not None
        return self.head(interpolate(fused, size=images.shape[2:], mode="bilinear", align_corners=False))[:, 0]


class DepthStandIn:
    """A DepthModel. Its depths are of the made clip, whose thing is red; the network's numbers are added by nought.

    Args:
        device: "cpu" or "cuda"; on CUDA the network is in bfloat16.

    Attributes:
        parameters: Their number.
    """

    family = "stand-in with random weights"
    kind: DepthKind | None = "disparity"
    at_once = 1
    never_waits = True

    def __init__(self, device: str):
        torch.manual_seed(0)
        self._device = torch.device(device)
        with torch.inference_mode(False):
            self._type = torch.bfloat16 if device == "cuda" else torch.float32
            self._network = _Network().eval().to(self._device, self._type)
        self.parameters = sum(part.numel() for part in self._network.parameters())

    def shrink(self, pixels: Pixels, shorter_px: int | None = None) -> Pixels:
        """See DepthModel."""
        scale = min(_SHORTER_PX, shorter_px or _SHORTER_PX) / min(pixels.shape[:2])
        height, width = (max(1, round(side * scale / _PATCH_PX)) * _PATCH_PX for side in pixels.shape[:2])
        return resized(pixels, height, width)

    def predict(self, pictures: Sequence[Pixels]) -> list[Prediction]:
        """See DepthModel."""
        images = normalized(pictures, self._device)
        numbers = self._network(images.to(self._type)).float()
        is_thing = images[:, 0] > images[:, 2]
        rows = torch.linspace(0, 0.2, images.shape[2], device=self._device)[:, None]
        values = torch.where(is_thing, 3.0, 1.0) + rows + 0 * numbers
        return [Prediction(part) for part in values]
