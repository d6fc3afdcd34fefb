"""How large splats are on the screen."""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs import _core


def radii_px(splats: Tensor) -> Tensor:
    """Half the longest extent of what each splat [..., SPLAT_FIELDS] covers, [...] in pixels; 0 where not drawn.

    That is where its alpha is 1/255 or more. A splat is stored in conditional form (csrc/math/projection.h): in units
    of log2 its inverse covariance is [[1/S, -c0/S], [-c0/S, tau + c0^2/S]], so its covariance [[S + c0^2/tau, c0/tau],
    [c0/tau, 1/tau]].
    """
    log2_opacity, square, tau, c0 = (splats[..., k] for k in _core.SPLAT_SHAPE_INDICES)
    down = 1 / tau
    across = square + c0 * c0 * down
    middle = (across + down) / 2
    longest = middle + torch.sqrt(((across - down) / 2).square() + (c0 * down).square())
    radii = torch.sqrt(longest * (log2_opacity - _core.LOG2_MIN_ALPHA).clamp_min(0))
    return torch.where(splats[..., _core.SPLAT_REACH_INDEX] >= 0, radii, torch.zeros_like(radii))
