"""Snap ramps of depth to the surfaces on their sides.

Where one surface ends before another, the network's depth runs down from the near one to the far one over some pixels.
Texels on this ramp hang between both, and from the side they are strands. Each takes the depth of one of the surfaces:
the weighted median of the depths around it that are not on a ramp, where like colours count more. Then the outline of
the near surface is cleaned by medians of all texels.

All lengths are chosen on the nine photos of the development data, at factors 1, 2 and 4, and on 24 textured objects of
512 px at factor 2. They are reported on the same data. Steepness decides: at 5 footprints a texel the tops of objects
are snapped too, at 20 the strands of a chair remain.

Everything has static shapes, for CUDA graphs. csrc/math/photo/ramps.h does the same natively.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs import _core

# Footprints of depth from texel to texel, to both sides: in the middle of a ramp, and anywhere on it. A step down
# counts by this fraction: eyes side by side do not see between surfaces one above the other
_STEEP, _SLOPE, _DOWN = 12.0, 1.5, 0.4
_APART = 6.0  # footprints between surfaces near a snapped ramp, for cleaning
_SNAPS, _CLEANS = 3, 4  # passes
# Pixels of the network's grid: half the length of a ramp, reach of cleaning beyond a ramp, and distance over which
# surfaces are apart
_REACH_PX, _AROUND_PX, _SPREAD_PX = 2.0, 1.5, 1.0
_SIMILAR = 0.1  # difference of colours of one surface, standard deviation
_THERE = 0.3  # least opacity of the object
_BIG = 1e6  # footprints
# A pass of the differentiable path snaps one texel in _PART at most, but _FEW in any case: its shapes are static
_PART, _FEW = 16, 4096


@dataclass(frozen=True)
class _Window:
    """Neighbours that a median takes.

    Attributes:
        radius: in steps.
        step: texels.
        deviation: standard deviation of the weight, texels.
        least: weight of other colours.
    """

    radius: int
    step: int
    deviation: float
    least: float


def _snap_window(factor: int) -> _Window:
    return _Window(radius=5, step=factor, deviation=2.5 * factor, least=0.1)


def _clean_window(factor: int) -> _Window:
    step = max(1, factor // 2)
    return _Window(radius=round(2.5 * factor / step), step=step, deviation=float(factor), least=0.3)


def _texels(pixels: float, factor: int) -> int:
    """Return a length of the network's pixels in texels."""
    return round(pixels * factor)


def ramp_look(factor: int) -> _core.RampLook:
    """Return the constants of the native stage."""
    windows = (_core.RampWindow(**vars(window)) for window in (_snap_window(factor), _clean_window(factor)))
    return _core.RampLook(
        steep=_STEEP,
        slope=_SLOPE,
        down=_DOWN,
        apart=_APART,
        similar=_SIMILAR,
        there=_THERE,
        reach=_texels(_REACH_PX, factor),
        around=_texels(_AROUND_PX, factor),
        spread=_texels(_SPREAD_PX, factor),
        snap=next(windows),
        clean=next(windows),
        snaps=_SNAPS,
        cleans=_CLEANS,
    )


def upsample_covered(disparity: Tensor, mask: Tensor, factor: int) -> Tensor:
    """Upsample disparities [B,1,H,W] bilinearly to factor times the size, each weighted by its opacity `mask`."""
    if factor == 1:
        return disparity
    weight = mask.clamp_min(1e-4)
    both = F.interpolate(torch.cat([disparity * weight, weight], 1), scale_factor=factor, mode="bilinear")
    return both[:, :1] / both[:, 1:]


def snap_ramps(disparity: Tensor, colour: Tensor, mask: Tensor, footprint: Tensor, factor: int) -> Tensor:
    """Return disparities [B,1,H,W] of the texels, those of ramps on the near or the far surface. Differentiable.

    Args:
        disparity: [B,1,H,W] of the texels.
        colour: [B,3,H,W] of the texels.
        mask: [B,1,H,W] of the texels.
        footprint: [B,1,1,1], width of a texel at depth 1.
        factor: texels per side of a pixel of the network's grid.
    """
    depth, there = -disparity.log() / footprint, mask > _THERE
    ramps = torch.zeros_like(there)
    for _ in range(_SNAPS):
        across, down = (least_step(depth, axis, there).abs() for axis in (3, 2))
        steep = (torch.maximum(across, _DOWN * down) > _STEEP) & there
        ramp = _near(steep, _texels(_REACH_PX, factor)) & (torch.maximum(across, down) > _SLOPE) & there
        ramps = ramps | ramp
        depth = _median(depth, colour, there & ~ramp, ramp, _snap_window(factor))
    around = _near(ramps, _texels(_AROUND_PX, factor)) & there
    for _ in range(_CLEANS):
        spread = _texels(_SPREAD_PX, factor)
        far, near = (_highest(torch.where(there, side, -_BIG), spread) for side in (depth, -depth))
        depth = _median(depth, colour, there, around & (far + near > _APART), _clean_window(factor))
    return torch.exp(-depth * footprint)


def least_step(values: Tensor, axis: int, counts: Tensor | None = None) -> Tensor:
    """Return the smaller of the steps to both neighbours where both go the same way (minmod), else 0.

    Args:
        values: [B,1,H,W].
        axis: 2 or 3; beyond the edges steps are 0.
        counts: bool, the pixels between which there is a step; None: all.
    """
    step = values.diff(dim=axis)
    if counts is not None:
        step = step * (counts.narrow(axis, 1, step.shape[axis]) & counts.narrow(axis, 0, step.shape[axis]))
    none = torch.zeros_like(values.narrow(axis, 0, 1))
    one, other = torch.cat([step, none], axis), torch.cat([none, step], axis)
    return torch.where(one * other > 0, torch.where(one.abs() < other.abs(), one, other), 0.0)


def _highest(values: Tensor, reach: int) -> Tensor:
    return F.max_pool2d(values, 2 * reach + 1, 1, reach)


def _near(marks: Tensor, reach: int) -> Tensor:
    """Return which texels have a mark at most `reach` rows and columns off."""
    return _highest(marks.float(), reach) > 0


def _median(depth: Tensor, colour: Tensor, counts: Tensor, wanted: Tensor, window: _Window) -> Tensor:
    """Return depths [B,1,H,W], the wanted ones replaced by the weighted median of the neighbours that count."""
    height, width = depth.shape[2:]
    offsets = [
        (window.step * y, window.step * x)
        for y in range(-window.radius, window.radius + 1)
        for x in range(-window.radius, window.radius + 1)
        if y * y + x * x <= window.radius**2
    ]
    down, right = torch.tensor(offsets, device=depth.device).unbind(1)
    distance = (down.square() + right.square()).to(depth.dtype)
    most = min(height * width, max(_FEW, height * width // _PART))
    chosen = wanted.flatten(1).to(depth.dtype).topk(most).indices
    rows, columns = chosen[..., None] // width + down, chosen[..., None] % width + right
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    index = (rows.clamp(0, height - 1) * width + columns.clamp(0, width - 1)).flatten(1)

    def gathered(channel: Tensor, at: Tensor = index) -> Tensor:
        return channel.flatten(1).gather(1, at).unflatten(1, (chosen.shape[1], -1))

    parts = [(gathered(part) - gathered(part, chosen)).square() for part in colour.unbind(1)]
    difference = parts[0] + parts[1] + parts[2]
    likeness = torch.exp(-difference / (2 * _SIMILAR**2)) + window.least
    weights = likeness * torch.exp(-distance / (2 * window.deviation**2)) * (gathered(counts) & inside)
    values, order = gathered(depth).sort(2)
    sums = weights.gather(2, order).cumsum(2)
    half = sums[..., -1:] / 2
    median = values.gather(2, (sums < half).sum(2, keepdim=True).clamp_max(len(offsets) - 1))
    is_found = gathered(wanted, chosen) & (half > 0)
    found = torch.where(is_found, median, gathered(depth, chosen))[..., 0]
    return depth.flatten(1).scatter(1, chosen, found).view_as(depth)
