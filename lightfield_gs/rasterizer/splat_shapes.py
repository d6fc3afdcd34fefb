"""What is read off splats: radii, projected means, conics, tiles.

Splats are [..., SPLAT_FIELDS], in conditional form (csrc/math/projection.h). In units of log2 the inverse covariance is
[[1/S, -c0/S], [-c0/S, tau + c0^2/S]], so the covariance is [[S + c0^2/tau, c0/tau], [c0/tau, 1/tau]].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial

import torch
from torch import Tensor

from lightfield_gs import _core

TILE_PX = 16  # side of the tiles that `splat_tiles` counts


def splat_numbers(splats: Tensor, names: Iterable[str], width: int, height: int) -> dict[str, Tensor]:
    """Return what splats [..., SPLAT_FIELDS] have of these names: radii, means2d, conics and tiles; see the functions.

    Args:
        splats: of any number of images.
        names: some of the four.
        width: of the images, pixels.
        height: likewise.
    """
    read: dict[str, Callable[[Tensor], Tensor]] = {
        "radii": splat_radii,
        "means2d": splat_means,
        "conics": splat_conics,
        "tiles": partial(splat_tiles, width=width, height=height),
    }
    return {name: read[name](splats) for name in names}


def splat_radii(splats: Tensor) -> Tensor:
    """Return half the longest extent of the region that each splat covers, [...] in pixels; 0 where it is not drawn.

    The region is where its alpha is 1/255 or more.
    """
    across, down, joint, reach = _covariance(splats)
    middle = (across + down) / 2
    longest = middle + torch.sqrt(((across - down) / 2).square() + joint.square())
    return torch.where(is_drawn(splats), torch.sqrt(longest * reach), torch.zeros_like(longest))


def is_drawn(splats: Tensor) -> Tensor:
    """Return which splats are drawn, [...]."""
    return splats[..., _core.SPLAT_REACH_INDEX] >= 0


def hidden_splats(splats: Tensor, masks: Tensor | None, near: float, far: float, radius: float) -> Tensor:
    """Return which splats are not to be drawn, [...].

    Args:
        splats: [..., SPLAT_FIELDS].
        masks: [...] bool, those that are drawn; None: all.
        near: depths from here on are drawn, scene units.
        far: depths up to here are drawn, scene units.
        radius: splats of this radius or a smaller one are not drawn, pixels.
    """
    depth = splats[..., _core.SPLAT_DEPTH_INDEX]
    hidden = (depth < near) | (depth > far)
    if radius > 0:
        hidden |= splat_radii(splats) <= radius
    return hidden if masks is None else hidden | ~masks


def splat_means(splats: Tensor) -> Tensor:
    """Return the projected means, [..., 2] in pixels (x right, y down); 0 where a splat is not drawn."""
    means = splats[..., list(_core.SPLAT_PLACE_INDICES)]
    return torch.where(is_drawn(splats)[..., None], means, torch.zeros_like(means))


def splat_conics(splats: Tensor) -> Tensor:
    """Return the inverses of the projected covariances with the blur, [..., 3] as xx, xy, yy in 1 / px^2.

    The weight is exp(-(xx dx^2 + 2 xy dx dy + yy dy^2) / 2); 0 where a splat is not drawn.
    """
    _, square, tau, c0 = (splats[..., k] for k in _core.SPLAT_SHAPE_INDICES)
    conics = 2 * math.log(2) * torch.stack([1 / square, -c0 / square, tau + c0 * c0 / square], -1)
    return torch.where(is_drawn(splats)[..., None], conics, torch.zeros_like(conics))


def splat_tiles(splats: Tensor, width: int, height: int) -> Tensor:
    """Return how many tiles of TILE_PX x TILE_PX pixels the box around each splat's region touches, [...] int32.

    Args:
        splats: [..., SPLAT_FIELDS].
        width: of the images, pixels.
        height: likewise.
    """
    across, down, _, reach = _covariance(splats)
    means, count = splat_means(splats), torch.ones_like(across)
    for axis, (variance, size) in enumerate(((across, width), (down, height))):
        half, last = torch.sqrt(variance * reach), (size - 1) // TILE_PX
        first, end = ((means[..., axis] + side * half) / TILE_PX for side in (-1, 1))
        count = count * (end.floor().clamp(-1, last) - first.floor().clamp(0, last + 1) + 1).clamp_min(0)
    return torch.where(is_drawn(splats), count, torch.zeros_like(count)).to(torch.int32)


def _covariance(splats: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return xx, yy and xy of the covariance, and the exponent at the edge of the region, in units of log2."""
    log2_opacity, square, tau, c0 = (splats[..., k] for k in _core.SPLAT_SHAPE_INDICES)
    down = 1 / tau
    return square + c0 * c0 * down, down, c0 * down, (log2_opacity - _core.LOG2_MIN_ALPHA).clamp_min(0)
