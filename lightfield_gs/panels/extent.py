"""Robust statistics of Gaussians, on any device: which of them count as content, and how far the content reaches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.rasterizer.quality import OPACITY_CUT
from lightfield_gs.scene.gaussians import Gaussians, from_tensors


@dataclass(frozen=True)
class ExtentConstants:
    """Thresholds of the content and its bounds.

    All are chosen by hand and not tuned on a data set; tests/panels/test_rig.py has the scenes that they must frame.
    """

    haze: float = 0.1  # fraction of the usual opacity below which a Gaussian is haze and does not count as content
    least_weight: float = 1e-6  # weight of a Gaussian at least, so that bounds exist even where all opacities are 0
    # fractions of the opacity outside the bounds on each side. The last one is usual, for thin ends of objects have a
    # thousandth of the opacity. An earlier one applies where the rest lies far out, as stray Gaussians of captures do
    tails: tuple[float, float, float] = (0.01, 0.001, 0.0001)
    far: float = 0.4  # distance of a side that is far out, in extents of the content without the first tail
    margin: float = 0.15  # margin of the bounds where the rest lies far out, in the same extents
    depth_tail: float = 0.05  # fraction of the opacity before the near depth, and behind the far one


_CONSTANTS = ExtentConstants()

_NEAR = _core.NEAR_DEPTH
_ENOUGH = 20_000  # Gaussians that measure the extent well enough for a search
_MANY = 1 << 17  # Gaussians that measure it to a thousandth or two


def content_extent(gaussians: Gaussians, world_to_camera: Tensor | None = None) -> Tensor:
    """Return left, right (x/z), top, bottom (y/z), near and far of the content, and its weight: [7].

    The edges are robust, see Rig.frame. The weight is the opacity in front of the camera. Nothing here waits
    for a device.

    Args:
        gaussians: One set.
        world_to_camera: [4, 4]; None: the Gaussians are in the camera's axes.
    """
    points, sizes, weights = gaussians.means, middle_scales(gaussians), content_weights(gaussians)
    if world_to_camera is not None:
        points = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depths = points[:, 2]
    weights = weights * (depths > _NEAR)
    depths = depths.clamp_min(_NEAR)
    # All rows are sorted at once: on a GPU the launches of a sort take longer than its numbers
    sides = _sides((points[:, :2] / depths[:, None]).T, sizes / depths)
    ordered, cumulative = _ordered(torch.cat([sides, depths[None]]), weights)
    edges = _bounds(ordered[:-1], cumulative[:-1])
    near, far = _percentiles(ordered[-1:], cumulative[-1:], (_CONSTANTS.depth_tail, 1 - _CONSTANTS.depth_tail))
    return torch.cat([edges.flatten(), near, far, weights.sum()[None]])


def content_bounds(gaussians: Gaussians, turn: Tensor | None = None) -> Tensor:
    """Return robust bounds [3, 2] (low, high) of the content.

    Args:
        gaussians: One set.
        turn: A rotation [3, 3] into the axes of the bounds; None: the world's.
    """
    means = gaussians.means if turn is None else gaussians.means @ turn.T
    return _bounds(*_ordered(_sides(means.T, middle_scales(gaussians)), content_weights(gaussians)))


def subsample(gaussians: Gaussians) -> Gaussians:
    """Return some of the Gaussians, enough to measure their extent."""
    return select(gaussians, slice(None, None, 1 + gaussians.count // _ENOUGH))


def hashed_subsample(gaussians: Gaussians) -> Gaussians:
    """Return all Gaussians, or of more than 2^17 one of each few neighbours in storage.

    A hash chooses it, so that columns and rows of a grid are met alike. Their number alone decides which ones; nothing
    waits for a device.
    """
    few = -(-gaussians.count // _MANY)
    if few == 1:
        return gaussians
    index = torch.arange(gaussians.count // few, device=gaussians.device)
    # Knuth's multiplicative hash, The Art of Computer Programming, vol. 3, section 6.4
    return select(gaussians, few * index + (index * 2654435761 >> 16) % few)


def select(gaussians: Gaussians, which: Tensor | slice) -> Gaussians:
    """Return the Gaussians that `which` selects: a slice, bool [N], or indices."""
    return from_tensors(field[which] for field in gaussians.fields().values())


def middle_scales(gaussians: Gaussians) -> Tensor:
    """Return the middle standard deviation of each Gaussian, [N]."""
    a, b, c = gaussians.scales.unbind(1)
    return torch.maximum(torch.minimum(a, b), torch.minimum(torch.maximum(a, b), c))


def content_weights(gaussians: Gaussians) -> Tensor:
    """Return the opacities [N] of the Gaussians that make up the scene, 0 for haze.

    The usual opacity depends on the scene's maker. Gaussians too faint to be drawn do not count, unless all are: a
    scene without them must give the same weights.
    """
    opacities = gaussians.opacities.clamp_min(_CONSTANTS.least_weight)
    visible = opacities >= OPACITY_CUT
    opacities = torch.where(visible | ~visible.any(), opacities, 0)
    usual = opacities.double().square().sum() / opacities.double().sum()
    return torch.where(opacities >= _CONSTANTS.haze * usual, opacities, 0)


def _sides(centres: Tensor, radii: Tensor) -> Tensor:
    """Return the low sides [D, N] of balls, and after them the negated high ones: the outermost of each are the least.

    Args:
        centres: [D, N].
        radii: [N].
    """
    return torch.cat([centres - radii, -centres - radii])


def _bounds(ordered: Tensor, cumulative: Tensor) -> Tensor:
    """Return robust bounds [D, 2] (low, high) of balls, from their sides as _ordered sorts them."""
    rest, *tails = _percentiles(ordered, cumulative, _CONSTANTS.tails)  # [2 D] each
    low, high = rest.chunk(2)
    extent = (-high - low).repeat(2)
    bounds = rest - _CONSTANTS.margin * extent
    for tail in tails:  # farther and farther out
        bounds = torch.where(rest - tail <= _CONSTANTS.far * extent, tail, bounds)
    low, high = bounds.chunk(2)
    return torch.stack([low, -high], 1)


def _ordered(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return each row of values [D, N] in ascending order, and the sums of the weights [N] up to each value."""
    ordered, order = values.sort(1)
    # A GPU sums one long row faster than a few short ones; the sum of the rows before is then subtracted from each
    sums = weights.double()[order].flatten().cumsum(0).view(order.shape)
    before = torch.cat([sums.new_zeros(1), sums[:-1, -1]])
    return ordered, sums - before[:, None]


def _percentiles(ordered: Tensor, cumulative: Tensor, fractions: Sequence[float]) -> Tensor:
    """Return the values [S, D] below which each fraction of the weights lies, for every row; see _ordered."""
    wanted = torch.stack([fraction * cumulative[:, -1] for fraction in fractions], 1)
    index = torch.searchsorted(cumulative, wanted).clamp_max(ordered.shape[1] - 1)
    return ordered.gather(1, index).T
