"""Residual U-Net: the feature extractor of every network configuration.

The layout is DDPM++ without noise conditioning (Song et al., "Score-Based Generative Modeling through Stochastic
Differential Equations", ICLR 2021). It has residual blocks that also resample, one skip connection per block, and
attention at chosen resolutions and in the middle. Splatter Image (Szymanowicz et al., CVPR 2024) uses it with 128
channels. Group normalisation is by Wu & He, ECCV 2018.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightfield_gs import _core
from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.stages import run_stage

MOST = 65536  # largest whole number in a configuration


def group_norm_silu(norm: nn.GroupNorm, features: Tensor) -> Tensor:
    """Return silu(norm(features)).

    In inference in bfloat16 on CUDA, channels last, one native kernel replaces PyTorch's six, two of which copy to
    channels first and back. It rounds once, PyTorch twice.

    Args:
        norm: the group normalisation.
        features: [B,C,H,W].

    Returns:
        [B,C,H,W].
    """
    if not _is_ours(norm, features):
        return F.silu(norm(features))
    batch, channels, height, width = features.shape
    out = torch.empty_like(features)
    sizes = (batch, height * width, channels, norm.num_groups)
    addresses = (tensor.data_ptr() for tensor in (features, norm.weight, norm.bias))
    run_stage("group_norm_silu", _core, features.device, *sizes, *addresses, norm.eps, out.data_ptr())
    return out


def _is_ours(norm: nn.GroupNorm, features: Tensor) -> bool:
    if torch.compiler.is_compiling() or torch.is_grad_enabled() or not (features.is_cuda and hasattr(_core, "cuda")):
        return False
    return (
        features.dtype == norm.weight.dtype == torch.bfloat16
        and features.is_contiguous(memory_format=torch.channels_last)
        and norm.num_channels % (2 * norm.num_groups) == 0
    )


def check_field_types(config: Any, where: str) -> None:
    """Raise InputError at the first field of a dataclass whose type differs from its default's."""
    for field in dataclasses.fields(config):
        value, default = getattr(config, field.name), field.default
        if isinstance(default, tuple):
            good = isinstance(value, tuple) and all(_is_count(v) for v in value)
            expected = f"a list of whole numbers up to {MOST}"
        elif isinstance(default, float):
            good = isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e9
            expected = "a number"
        elif isinstance(default, int) and not isinstance(default, bool):
            good, expected = _is_count(value), f"a whole number up to {MOST}"
        else:
            good, expected = isinstance(value, type(default)), type(default).__name__
        if not good:
            raise InputError(f"model configuration: {where}{field.name}: expected {expected}, got {shown(value)}")


def check_ranges(config: Any, where: str, checks: Iterable[tuple[bool, str, str]]) -> None:
    """Raise InputError at the first field that fails; checks: whether it is good, its name, and the expectation."""
    for good, field, expected in checks:
        if not good:
            value = shown(getattr(config, field))
            raise InputError(f"model configuration: {where}{field}: expected {expected}, got {value}")


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MOST


@dataclass(frozen=True)
class UNetConfig:
    """Shape and initialisation of a U-Net.

    Attributes:
        base_channels: channels at the first level.
        multipliers: channels of each level in units of base_channels.
        blocks: residual blocks per level on the way down (one more on the way up).
        attention_px: side lengths of feature maps, at the network's nominal input size, that get self-attention.
        heads: attention heads.
        dropout: probability in [0, 1) inside residual blocks.
        residual_scale: factor on the sum of the two branches; sqrt(0.5) keeps variances in the original network.
        zero_init: True starts every residual branch at zero. False uses the original's Xavier-uniform weights (gain
            1e-5 instead of zero for the second convolution).
    """

    base_channels: int = 32
    multipliers: tuple[int, ...] = (1, 2, 4, 4)
    blocks: int = 2
    attention_px: tuple[int, ...] = (16,)
    heads: int = 4
    dropout: float = 0.0
    residual_scale: float = 1.0
    zero_init: bool = True

    def __post_init__(self) -> None:
        """Check the values of all fields. Raises InputError."""
        check_field_types(self, "unet.")
        levels = 0 < len(self.multipliers) <= 16 and min(self.multipliers) >= 1
        divides = self.heads >= 1 and all(self.base_channels * m % self.heads == 0 for m in self.multipliers)
        checks = (
            (self.base_channels >= 4, "base_channels", "at least 4"),
            (levels, "multipliers", "a number per level, at least 1, for at most 16 levels"),
            (1 <= self.blocks <= 64, "blocks", "1 to 64"),
            (divides, "heads", "a divisor of every level's channels"),
            (0 <= self.dropout < 1, "dropout", "0 to 1, less than 1"),
        )
        check_ranges(self, "unet.", checks)


def _group_norm(channels: int) -> nn.GroupNorm:
    """Make a group norm of at most 32 groups, of at least four channels each, that divide the channels evenly."""
    groups = next(count for count in range(min(32, channels // 4), 0, -1) if channels % count == 0)
    return nn.GroupNorm(groups, channels, eps=1e-6)


def _convolution(inputs: int, outputs: int, kernel: int, *, gain: float | None = None) -> nn.Conv2d:
    """Make a same-size convolution.

    Args:
        gain: Gain of the Xavier-uniform weights; None: PyTorch's own initialisation.
    """
    layer = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)
    if gain is not None:
        nn.init.xavier_uniform_(layer.weight, gain)
        nn.init.zeros_(cast(Tensor, layer.bias))
    return layer


def _resample(features: Tensor, factor: float) -> Tensor:
    """Halve by averaging 2x2 pixels, double by repeating them, or keep the size (factor 1/2, 2, 1)."""
    if factor == 0.5:
        return F.avg_pool2d(features, 2)
    return F.interpolate(features, scale_factor=2.0, mode="nearest") if factor == 2 else features


class Attention(nn.Module):
    """Self-attention over all pixels of a feature map, with a residual connection."""

    def __init__(self, channels: int, config: UNetConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.norm = _group_norm(channels)
        gain = None if config.zero_init else math.sqrt(0.2)
        self.queries_keys_values = _convolution(channels, 3 * channels, 1, gain=gain)
        self.projection = _convolution(channels, channels, 1, gain=0.0 if config.zero_init else 1e-5)

    def forward(self, features: Tensor) -> Tensor:
        """Attend.

        Args:
            features: [B,C,H,W], the shape of the result.
        """
        batch, channels, height, width = features.shape
        packed = self.queries_keys_values(self.norm(features)).flatten(2)
        packed = packed.reshape(batch, 3, self.heads, channels // self.heads, height * width).transpose(3, 4)
        mixed = F.scaled_dot_product_attention(packed[:, 0], packed[:, 1], packed[:, 2])
        return features + self.projection(mixed.transpose(2, 3).reshape(batch, channels, height, width))


class ResidualBlock(nn.Module):
    """Norm, SiLU, 3x3 convolution, twice, beside a shortcut; may halve or double the resolution.

    Args:
        inputs, outputs: channels.
        config: of the U-Net.
        factor: of the resolution, 1/2, 1 or 2.
        attention: whether self-attention follows.
    """

    def __init__(
        self, inputs: int, outputs: int, config: UNetConfig, *, factor: float = 1, attention: bool = False
    ) -> None:
        super().__init__()
        gain = None if config.zero_init else 1.0
        self.outputs, self.factor, self.scale = outputs, factor, config.residual_scale
        self.norm_1, self.norm_2 = _group_norm(inputs), _group_norm(outputs)
        self.convolution_1 = _convolution(inputs, outputs, 3, gain=gain)
        self.dropout = nn.Dropout(config.dropout)
        self.convolution_2 = _convolution(outputs, outputs, 3, gain=0.0 if config.zero_init else 1e-5)
        # The original projects the shortcut wherever it resamples; with zero_init that would only cost time.
        projects = inputs != outputs or (factor != 1 and not config.zero_init)
        self.shortcut = _convolution(inputs, outputs, 1, gain=gain) if projects else nn.Identity()
        self.attention = Attention(outputs, config) if attention else None

    def forward(self, features: Tensor) -> Tensor:
        """Map features [B,inputs,H,W] to [B,outputs,factor * H,factor * W]."""
        branch = self.convolution_1(_resample(group_norm_silu(self.norm_1, features), self.factor))
        branch = self.convolution_2(self.dropout(group_norm_silu(self.norm_2, branch)))
        features = self.shortcut(_resample(features, self.factor))
        features = (features + branch) * self.scale if self.scale != 1 else features + branch
        if self.attention is None:
            return features
        features = self.attention(features)
        return features * self.scale if self.scale != 1 else features


class UNet(nn.Module):
    """A U-Net from [B,inputs,H,W] to [B,outputs,H,W].

    Args:
        inputs, outputs: channels.
        size_px: the side length that attention_px refers to; the weights work at any other size too.
        config: its shape.
    """

    def __init__(self, inputs: int, outputs: int, size_px: int, config: UNetConfig) -> None:
        super().__init__()
        channels = [config.base_channels * m for m in config.multipliers]
        attends = [size_px >> level in config.attention_px for level in range(len(channels))]
        gain = None if config.zero_init else 1.0
        self.stem = _convolution(inputs, channels[0], 3, gain=gain)
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        width, skips = channels[0], [channels[0]]
        for level, outputs_here in enumerate(channels):
            if level > 0:
                self.down.append(ResidualBlock(width, width, config, factor=0.5))
                skips.append(width)
            for _ in range(config.blocks):
                self.down.append(ResidualBlock(width, outputs_here, config, attention=attends[level]))
                width = outputs_here
                skips.append(width)
        self.middle = nn.Sequential(
            ResidualBlock(width, width, config, attention=True), ResidualBlock(width, width, config)
        )
        for level, outputs_here in reversed(list(enumerate(channels))):
            if level < len(channels) - 1:
                self.up.append(ResidualBlock(width, width, config, factor=2))
            for index in range(config.blocks + 1):
                attention = attends[level] and index == config.blocks
                self.up.append(ResidualBlock(width + skips.pop(), outputs_here, config, attention=attention))
                width = outputs_here
        self.norm = _group_norm(width)
        self.output = _convolution(width, outputs, 3, gain=None if config.zero_init else 0.2)

    def forward(self, image: Tensor) -> Tensor:
        """Map an image [B,inputs,H,W] to features [B,outputs,H,W]; H and W are multiples of 2^(levels - 1)."""
        features = self.stem(image)
        skips = [features]
        for block in self.down:
            features = block(features)
            skips.append(features)
        features = self.middle(features)
        for block in self.up:
            if block.factor == 1:
                features = torch.cat([features, skips.pop()], dim=1)
            features = block(features)
        return self.output(group_norm_silu(self.norm, features))
