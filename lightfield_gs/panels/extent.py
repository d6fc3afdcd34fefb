"""Robust statistics of Gaussians: which of them count as content, and how far the content reaches."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.rasterizer.quality import OPACITY_CUT
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

_HAZE = 0.1  # Gaussians fainter than this share of the usual opacity do not count as content
_LEAST_WEIGHT = 1e-6  # that a Gaussian has, so that bounds exist even where all opacities are 0
# Shares of the opacity that may lie outside the bounds on each side. Usually it is the last one, for thin ends of
# objects have a thousandth of the opacity and less. It is an earlier one where what lies beyond is far out, as the
# stray Gaussians of captures are.
_TAILS = (0.01, 0.001, 0.0001)
# In extents of what is left without the first tail: what is farther off than _FAR is far out, and the bounds then leave
# it _ROOM.
_FAR, _ROOM = 0.4, 0.15
_DEPTH_TAIL = 0.05  # share of the opacity that lies before the near depth, and behind the far one
_NEAR = _core.NEAR_DEPTH
_ENOUGH = 20_000  # Gaussians that show well enough how far all of them reach
_MANY = 1 << 17  # that show it to a thousandth or two


def content_extent(gaussians: Gaussians, world_to_camera: Tensor | None = None) -> Tensor:
    """What `fit` needs to know, [7]: left, right (x/z), top, bottom (y/z), near and far of the content, weight of it.

    The edges are robust (see framing.frame); the weight is the opacity of what lies in front of the camera. None: the
    Gaussians are in the camera's axes. Nothing here waits for a device.
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
    near, far = _percentiles(ordered[-1:], cumulative[-1:], (_DEPTH_TAIL, 1 - _DEPTH_TAIL))
    return torch.cat([edges.flatten(), near, far, weights.sum()[None]])


def content_bounds(gaussians: Gaussians, turn: Tensor | None = None) -> Tensor:
    """Robust bounds [3, 2] (low, high) of the content; turn: a rotation [3, 3] into the axes that they are along."""
    means = gaussians.means if turn is None else gaussians.means @ turn.T
    return _bounds(*_ordered(_sides(means.T, middle_scales(gaussians)), content_weights(gaussians)))


def subsample(gaussians: Gaussians) -> Gaussians:
    """Some of them, as many as show how far they reach."""
    return select(gaussians, slice(None, None, 1 + gaussians.count // _ENOUGH))


def hashed_subsample(gaussians: Gaussians) -> Gaussians:
    """All of them, or of more than _MANY one of each few that are stored side by side, as if at random, so that those
    of a grid's columns and rows are met alike. Which ones, their number decides alone; nothing waits for a device."""
    few = -(-gaussians.count // _MANY)
    if few == 1:
        return gaussians
    place = torch.arange(gaussians.count // few, device=gaussians.device)
    # Knuth's multiplicative hash, The Art of Computer Programming, vol. 3, section 6.4
    return select(gaussians, few * place + (place * 2654435761 >> 16) % few)


def select(gaussians: Gaussians, which: Tensor | slice) -> Gaussians:
    """The Gaussians that `which` selects, a slice, bool [N] or their numbers in a row."""
    return from_tensors(field[which] for field in gaussians.fields().values())


def middle_scales(gaussians: Gaussians) -> Tensor:
    """The middle standard deviations [N]."""
    a, b, c = gaussians.scales.unbind(1)
    return torch.maximum(torch.minimum(a, b), torch.minimum(torch.maximum(a, b), c))


def content_weights(gaussians: Gaussians) -> Tensor:
    """Opacities [N] of the Gaussians that make up the scene, 0 of haze; what is usual depends on how it was made.

    Those too faint to be drawn do not count, unless all are: whoever left them out must find the same.
    """
    opacities = gaussians.opacities.clamp_min(_LEAST_WEIGHT)
    drawn = opacities >= OPACITY_CUT
    opacities = torch.where(drawn | ~drawn.any(), opacities, 0)
    usual = opacities.double().square().sum() / opacities.double().sum()
    return torch.where(opacities >= _HAZE * usual, opacities, 0)


def _sides(centres: Tensor, radii: Tensor) -> Tensor:
    """Low sides [D, N] of balls with these centres [D, N] and radii [N], and after them the high ones, negated: of each
    the outermost are the least."""
    return torch.cat([centres - radii, -centres - radii])


def _bounds(ordered: Tensor, cumulative: Tensor) -> Tensor:
    """Robust bounds [D, 2] (low, high) of balls, from their sides as _ordered puts them."""
    rest, *tails = _percentiles(ordered, cumulative, _TAILS)  # [2 D] each
    low, high = rest.chunk(2)
    extent = (-high - low).repeat(2)
    bounds = rest - _ROOM * extent
    for tail in tails:  # farther and farther out
        bounds = torch.where(rest - tail <= _FAR * extent, tail, bounds)
    low, high = bounds.chunk(2)
    return torch.stack([low, -high], 1)


def _ordered(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Every row of values [D, N] in ascending order, and the sums of the weights [N] up to each."""
    ordered, order = values.sort(1)
    # A GPU sums one long row faster than a few short ones; the sum of the rows before is then subtracted from each
    sums = weights.double()[order].flatten().cumsum(0).view(order.shape)
    before = torch.cat([sums.new_zeros(1), sums[:-1, -1]])
    return ordered, sums - before[:, None]


def _percentiles(ordered: Tensor, cumulative: Tensor, shares: Sequence[float]) -> Tensor:
    """For each share the values [S, D] below which that share of the weights lies, for every row; see _ordered."""
    wanted = torch.stack([share * cumulative[:, -1] for share in shares], 1)
    index = torch.searchsorted(cumulative, wanted).clamp_max(ordered.shape[1] - 1)
    return ordered.gather(1, index).T
