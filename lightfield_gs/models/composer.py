"""Last stage of the network: channels of the heads become Gaussians in the source camera's axes."""

from __future__ import annotations

import itertools
import math
from typing import cast

import torch
from torch import Tensor, nn

from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.models.config import ModelConfig
from lightfield_gs.models.initializer import Pixels, flat
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

# Opacity logits of untrained Gaussians inside and outside the object's mask: first layer, layers behind it. Lines
# of sight outside the mask meet nothing, so their Gaussians start below the visible 1/255 and cost nothing.
_LOGITS_FIRST, _LOGITS_BEHIND = (1.0, -6.0), (-1.0, -6.0)
# Standard deviation of an untrained Gaussian in pixel footprints: neighbours 1 apart close into a surface.
_BASE_SCALE = 0.75
# Bounds of the logarithm of scale / base. Smaller ones would leave holes in magnified views.
_LOG_SCALE_RANGE = (-0.7, 2.5)


def parameter_groups(sh_degree: int) -> dict[str, int]:
    """Return the channels that the heads predict for each Gaussian, in order."""
    groups = {"depth": 1, "offset": 3, "opacity": 1, "scale": 3, "rotation": 4, "colour": 3}
    return groups | ({"harmonics": 3 * ((sh_degree + 1) ** 2 - 1)} if sh_degree else {})


def _mirror_signs(sh_degree: int) -> list[int]:
    """Return the sign of each channel of one layer under reflection in the plane x = 0."""
    signs = {"offset": [-1, 1, 1], "rotation": [1, 1, -1, -1]}
    # A real harmonic is proportional to sin(|m| phi) where m < 0, else to cos(m phi); the mirror maps phi to pi - phi.
    signs["harmonics"] = [
        (-1) ** (m if m >= 0 else m + 1)
        for band in range(1, sh_degree + 1)
        for m in range(-band, band + 1)
        for _ in range(3)
    ]
    return [
        sign for group, channels in parameter_groups(sh_degree).items() for sign in signs.get(group, [1] * channels)
    ]


def mirrored(raw: Tensor, layers: int, sh_degree: int) -> Tensor:
    """Reflect raw channels, left and right.

    Args:
        raw: [B,C,H,W], output of the heads.
        layers: Gaussians per pixel.
        sh_degree: degree of the harmonics.

    Returns:
        [B,C,H,W]; its Gaussians mirror the Gaussians of `raw`.
    """
    signs = _mirror_signs(sh_degree) * layers
    flipped, start, parts = raw.flip(3), 0, []
    for sign, run in itertools.groupby(signs):  # slices: a tensor of signs would be copied to the device
        channels = flipped[:, start : start + len(list(run))]
        start += channels.shape[1]
        parts.append(channels if sign > 0 else -channels)
    return torch.cat(parts, dim=1)


def _harmonics(constant: Tensor, rest: Tensor | None) -> Tensor:
    """Combine the constant term [B,3,H,W] and the others [B,3(K-1),H,W] (coefficient-major) to [B,H*W,K,3]."""
    coefficients = flat(constant)[:, :, None]
    return coefficients if rest is None else torch.cat([coefficients, flat(rest).unflatten(2, (-1, 3))], dim=2)


class DeltaComposer(nn.Module):
    """Base Gaussians from the picture plus predicted changes; layers lie one behind the other on each line of sight.

    Depth is linear in disparity 1/z between far and near, since a step in disparity moves a pixel by the same amount
    at any depth. Offsets and scales are in footprints of the Gaussian's pixel at its depth. Colours are input +
    change.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.layers, self.groups = config.layers, parameter_groups(config.sh_degree)
        self.far_disparity, self.disparity_range = 1 / config.far, 1 / config.near - 1 / config.far
        base = (1 / config.base_depth - self.far_disparity) / self.disparity_range
        self.base_logit = math.log(base / (1 - base))

    def forward(self, raw: Tensor, pixels: Pixels) -> Gaussians:
        """Compose the Gaussians.

        Args:
            raw: [B, layers * sum(groups), H, W] float32; zeros give the base Gaussians.
            pixels: of the picture, [B,.,H,W].

        Returns:
            Gaussians with leading B and N = layers * H * W.
        """
        nearness: Tensor | float = 1.0
        parts: list[tuple[Tensor, ...]] = []
        for index, layer in enumerate(raw.chunk(self.layers, dim=1)):
            values = dict(zip(self.groups, layer.split(list(self.groups.values()), dim=1)))
            # The fraction of the disparity range shrinks from layer to layer: each layer lies behind its predecessor.
            nearness = nearness * torch.sigmoid(values["depth"] + (self.base_logit if index == 0 else 0.0))
            parts.append(self._layer(values, 1 / (self.far_disparity + self.disparity_range * nearness), pixels, index))
        return from_tensors(torch.cat(fields, dim=1) for fields in zip(*parts))

    def _layer(self, values: dict[str, Tensor], depth: Tensor, pixels: Pixels, index: int) -> tuple[Tensor, ...]:
        """Return means, quaternions, scales, opacities and harmonics of one layer at depth [B,1,H,W]."""
        footprint = pixels.footprint * depth
        reach = footprint if index == 0 else 2 * footprint
        means = torch.cat([pixels.rays * depth, depth], dim=1) + reach * values["offset"]
        quaternions = torch.cat([1 + values["rotation"][:, :1], values["rotation"][:, 1:]], dim=1)
        scales = _BASE_SCALE * footprint * values["scale"].clamp(*_LOG_SCALE_RANGE).exp()
        inside, outside = _LOGITS_FIRST if index == 0 else _LOGITS_BEHIND
        opacities = torch.sigmoid(values["opacity"] + outside + (inside - outside) * pixels.mask)
        constant = (pixels.colour + values["colour"] - 0.5) / SH_CONSTANT
        harmonics = _harmonics(constant, values.get("harmonics"))
        return flat(means), flat(quaternions), flat(scales), flat(opacities)[..., 0], harmonics


class AbsoluteComposer(nn.Module):
    """The activations of Splatter Image (Szymanowicz et al., CVPR 2024, section 3.2 and its supplement)."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.near, self.far, self.groups = config.near, config.far, parameter_groups(config.sh_degree)

    def forward(self, raw: Tensor, pixels: Pixels) -> Gaussians:
        """Compose the Gaussians.

        Args:
            raw: [B, sum(groups), H, W] float32.
            pixels: of the picture, [B,.,H,W].

        Returns:
            Gaussians with leading B and N = H * W.
        """
        values = dict(zip(self.groups, raw.split(list(self.groups.values()), dim=1)))
        depth = self.near + (self.far - self.near) * torch.sigmoid(values["depth"])
        means = torch.cat([pixels.rays * depth, depth], dim=1) + values["offset"]
        harmonics = _harmonics(values["colour"], values.get("harmonics"))
        return Gaussians(
            flat(means),
            flat(torch.nn.functional.normalize(values["rotation"], dim=1)),
            flat(values["scale"].exp()),
            flat(torch.sigmoid(values["opacity"]))[..., 0],
            harmonics,
        )

    def initialise(self, head: nn.Conv2d, block: int) -> None:
        """Initialise the 1x1 head: Xavier gain and bias of each group, as published for objects.

        Args:
            head: the convolution.
            block: channels of the head per predicted number (pixels of a patch).
        """
        settings = {
            "depth": (1.0, 0.0),
            "offset": (0.1, 0.0),
            "opacity": (1.0, -2.0),
            "scale": (0.003, math.log(0.02)),
            "rotation": (1.0, 0.0),
            "colour": (5.0, 0.0),
            "harmonics": (0.0, 0.0),
        }
        start = 0
        for group, channels in self.groups.items():
            gain, bias = settings[group]
            channels *= block
            nn.init.xavier_uniform_(head.weight.data[start : start + channels], gain)
            nn.init.constant_(cast(Tensor, head.bias).data[start : start + channels], bias)
            start += channels
