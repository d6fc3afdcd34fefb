"""Edges of depth maps, and alpha mattes along them.

All depth maps here are [H, W], view-space z in scene units, NaN where nothing was measured.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from torch import Tensor
from torch.nn import functional

from lightfield_gs.photo.image_filters import max_filter

# Neighbours belong to one surface up to this slope, depth per sideways length: tan 85 degrees. A steeper step is an
# edge between two surfaces, which opens by some 4 pixels over a cone of 40 degrees.
STEEPEST = 11.4


@dataclass(frozen=True)
class DepthEdgeConstants:
    """Thresholds of edges and mattes.

    All are chosen by hand and not tuned on a data set; tests/photo has the pictures that they must tell apart.
    """

    snap_passes: int = 3  # passes, each of which takes one pixel off both ends of a smoothed edge
    sliver_px: int = 24  # pixels of a piece between two surfaces that is no surface of its own, at most
    sliver_window_px: int = 3  # pixels to each side in which these surfaces are looked for
    rim_px: int = 3  # pixels on either side of an edge whose colours may be mixed
    window_px: int = 6  # pixels to each side from which the colours of both surfaces are taken
    window_std: float = 3.0  # standard deviation of the weights in this window, pixels
    step_ratio: float = 1.03  # ratio of disparities from which on two pixels belong to different surfaces
    noise: float = 2e-4  # variance of a colour, 0..1, that is no difference
    trace: float = 0.04  # coverage that is not visible


_C = DepthEdgeConstants()


def joined(depth: Tensor, focal_px: float, steepest: float = STEEPEST) -> Tensor:
    """Return whether each pixel and its right neighbour belong to one surface, bool [H, W-1]."""
    left, right = depth[:, :-1], depth[:, 1:]
    return (right - left).abs() * focal_px <= steepest * torch.minimum(left, right)


def edges(depth: Tensor, focal_px: tuple[float, float]) -> Tensor:
    """Return whether each pixel has a depth and another surface beside it, in any of four directions, bool [H, W]."""
    there = torch.isfinite(depth)
    result = torch.zeros_like(there)
    for whole, mine, marked in (
        (joined(depth, focal_px[0]), there, result),
        (joined(depth.T, focal_px[1]), there.T, result.T),
    ):
        torn = ~whole & mine[:, 1:] & mine[:, :-1]
        marked[:, 1:] |= torn
        marked[:, :-1] |= torn
    return result


def slopes(depth: Tensor, focal_px: float, steepest: float = STEEPEST) -> Tensor:
    """Return depth per sideways length from column to column, [H, W], dimensionless.

    It is the mean of the steps to the neighbours on the same surface, 0 without any.
    """
    whole = joined(depth, focal_px, steepest)
    steps = torch.where(whole, depth[:, 1:] - depth[:, :-1], 0)
    total, count = (functional.pad(part, (1, 0)) + functional.pad(part, (0, 1)) for part in (steps, whole.to(steps)))
    return total / count.clamp_min(1) * focal_px / depth


def snap_mixed(depth: Tensor, focal_px: tuple[float, float]) -> Tensor:
    """Return the depth map with its smoothed edges made sharp again, [H, W].

    A pixel with an edge on both sides along its row or column lies on neither surface. It takes the depth of the
    neighbour that is nearer in disparity. Thin things, nearer or farther than both neighbours, stay.
    """
    for _ in range(_C.snap_passes):
        depth = _snap_columns(depth, focal_px[0])
        depth = _snap_columns(depth.T, focal_px[1]).T
    return depth


def _snap_columns(depth: Tensor, focal_px: float) -> Tensor:
    whole = joined(depth, focal_px)
    steps = (1 / depth).diff(dim=1)
    before, after = steps[:, :-1], steps[:, 1:]
    mixed = ~whole[:, :-1] & ~whole[:, 1:] & (before * after > 0)
    neighbour = torch.where(before.abs() <= after.abs(), depth[:, :-2], depth[:, 2:])
    snapped = depth.clone()
    snapped[:, 1:-1] = torch.where(mixed, neighbour, depth[:, 1:-1])
    return snapped


def merge_slivers(depth: Tensor, image: Tensor, focal_px: tuple[float, float]) -> Tensor:
    """Return the depth map without small pieces between a near and a far surface, which hang in the gap from the sides.

    Each of their pixels takes the depth of the surface close by whose colour is more like its own. Small things that
    are nearer or farther than all around them stay.

    Args:
        depth: [H, W].
        image: [H, W, 3 or more], the photo.
        focal_px: (fx, fy), pixels.
    """
    known = torch.isfinite(depth)
    small = _small_pieces(depth, focal_px) & known
    rows, columns = small.nonzero().unbind(1)
    if not len(rows):
        return depth
    disparity = (1 / depth).nan_to_num(0)
    surfaces = torch.where(small, 0, disparity)  # 0: none
    reach, width = _C.sliver_window_px, depth.shape[1] + 2 * _C.sliver_window_px
    maps = torch.cat([image[..., :3].movedim(2, 0), surfaces[None]])
    values = functional.pad(maps, (reach,) * 4).movedim(0, 2).reshape(-1, 4)
    steps = torch.arange(-reach, reach + 1, device=depth.device)
    window = (steps[:, None] * width + steps).flatten()
    merged = disparity.clone()
    for start in range(0, len(rows), _CHUNK):
        row, column = rows[start : start + _CHUNK], columns[start : start + _CHUNK]
        around = values[((row + reach) * width + column + reach)[:, None] + window]
        own, there = disparity[row, column][:, None], around[..., 3]
        groups = torch.stack([(there > 0) & (there < own), there > own], 1).to(around)
        counts = groups.sum(2, keepdim=True)
        means = groups @ around / counts.clamp_min(1)
        apart = (means[..., :3] - image[row, column, None, :3]).square().sum(2)
        chosen = means[..., 3].gather(1, apart.argmin(1, keepdim=True))[:, 0]
        merged[row, column] = torch.where((counts > 0).all(1)[:, 0], chosen, own[:, 0])
    return torch.where(small, 1 / merged, depth)


def _small_pieces(depth: Tensor, focal_px: tuple[float, float]) -> Tensor:
    """Return the pixels of pieces of joined pixels that are too small for a surface, bool [H, W]."""
    # All pixels of a small piece are close to an edge; those of other pieces in this band are joined to the rest
    band = max_filter(edges(depth, focal_px), math.isqrt(_C.sliver_px)).cpu().numpy()
    numbers = np.cumsum(band.ravel()).reshape(band.shape) * band  # 0: the rest
    ends = []
    for places, whole in (
        (numbers, joined(depth, focal_px[0]).cpu().numpy()),
        (numbers.T, joined(depth.T, focal_px[1]).cpu().numpy()),
    ):
        ends.append(np.stack([places[:, :-1][whole], places[:, 1:][whole]]))
    one, other = np.concatenate(ends, 1)
    count = 1 + int(band.sum())
    links = sparse.coo_matrix((np.ones(len(one), bool), (one, other)), (count, count))
    _, piece = sparse.csgraph.connected_components(links, directed=False)
    is_small = np.bincount(piece) <= _C.sliver_px
    is_small[piece[0]] = False
    return torch.from_numpy(is_small[piece][numbers] & band).to(depth.device)


_CHUNK = 1 << 12  # pixels whose windows are gathered at a time: 16 MB


class Matte(NamedTuple):
    """The M pixels beside edges.

    Attributes:
        rows: [M] int64.
        columns: [M] int64.
        is_near: bool [M], whether the depth map has the near surface there.
        alpha: [M], coverage by the near surface, 0..1.
        near: [M, 3], colour of the near surface.
        far: [M, 3], colour of the far surface.
        depth: [M], z of the near surface.
    """

    rows: Tensor
    columns: Tensor
    is_near: Tensor
    alpha: Tensor
    near: Tensor
    far: Tensor
    depth: Tensor


def find_matte(image: Tensor, depth: Tensor, torn: Tensor) -> Matte:
    """Return the matte of the pixels beside the edges of a photo.

    A mixed pixel is I = a F + (1 - a) B. F and B are the mean colours of the two surfaces close by, outside the band of
    mixed pixels, and a = (I - B).(F - B) / |F - B|^2. Where the two colours differ by no more than their own variation,
    colour says nothing, and the depth map decides: the ratio of the two draws a to 0 or 1.

    Args:
        image: [H, W, 3], 0..1.
        depth: z [H, W].
        torn: bool [H, W], the pixels that have an edge to a neighbour.
    """
    disparity = (1 / depth).nan_to_num(0)
    most = max_filter(disparity, _C.rim_px)
    least = -max_filter(-torch.where(disparity > 0, disparity, 1e30), _C.rim_px)
    band = max_filter(torn, _C.rim_px - 1)
    band &= torch.isfinite(depth) & (most > _C.step_ratio * least)
    rows, columns = band.nonzero().unbind(1)
    middle = ((most + least) / 2)[rows, columns]
    is_near = disparity[rows, columns] > middle
    near, far = _measure_surfaces(image, disparity, ~band, rows, columns, middle)
    known = (near.weight > 0) & (far.weight > 0)
    rows, columns, is_near = rows[known], columns[known], is_near[known]
    colour = image[rows, columns]
    f, b = near.mean[known], far.mean[known]
    apart = ((f - b) ** 2).sum(1)
    alpha = (((colour - b) * (f - b)).sum(1) / apart.clamp_min(1e-9)).clamp(0, 1)
    sure = apart / (apart + 4 * torch.where(is_near, near.variance[known], far.variance[known]) + _C.noise)
    hard = is_near.float()
    alpha = sure * alpha + (1 - sure) * hard
    alpha = torch.where((alpha - hard).abs() < _C.trace, hard, alpha)
    # Each surface takes its visible part of the pixel's difference, so that both together give the pixel again
    rest = (colour - alpha[:, None] * f - (1 - alpha[:, None]) * b) / (alpha**2 + (1 - alpha) ** 2)[:, None]
    own_near, own_far = (f + alpha[:, None] * rest).clamp(0, 1), (b + (1 - alpha[:, None]) * rest).clamp(0, 1)
    return Matte(rows, columns, is_near, alpha, own_near, own_far, 1 / near.disparity[known].clamp_min(1e-30))


class _Surface(NamedTuple):
    """One of the two surfaces by each pixel: weight [M], mean [M, 3] and variance [M] of its colours, disparity [M]."""

    weight: Tensor
    mean: Tensor
    variance: Tensor
    disparity: Tensor


def _measure_surfaces(
    image: Tensor, disparity: Tensor, clean: Tensor, rows: Tensor, columns: Tensor, middle: Tensor
) -> tuple[_Surface, _Surface]:
    """Return the near and the far surface close to these pixels, from pixels that are not mixed."""
    padding, width = (_C.window_px,) * 4, disparity.shape[1] + 2 * _C.window_px
    channels = torch.cat(
        [image.movedim(2, 0), (image**2).sum(2)[None], disparity[None], torch.ones_like(disparity)[None]]
    )
    values = functional.pad(channels, padding).movedim(0, 2).reshape(-1, 6)
    usable = torch.where(clean & (disparity > 0), disparity, torch.nan)
    usable = functional.pad(usable, padding, value=torch.nan).flatten()
    reach = torch.arange(-_C.window_px, _C.window_px + 1, device=image.device)
    window_weights = torch.exp(-(reach[:, None] ** 2 + reach**2) / 2 / _C.window_std**2).flatten()
    window = ((reach[:, None] + _C.window_px) * width + reach + _C.window_px).flatten()
    sums = image.new_zeros(2, len(rows), 6)
    for start in range(0, len(rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        at = (rows[part] * width + columns[part])[:, None] + window
        there, level = usable[at], middle[part, None]
        weights = torch.stack([there > level, there <= level], 1) * window_weights
        sums[:, part] = (weights @ values[at]).movedim(1, 0)
    surfaces = []
    for total in sums:
        weight = total[:, 5]
        mean = total[:, :5] / weight.clamp_min(1e-12)[:, None]
        variance = (mean[:, 3] - (mean[:, :3] ** 2).sum(1)).clamp_min(0)
        surfaces.append(_Surface(weight, mean[:, :3], variance, mean[:, 4]))
    return surfaces[0], surfaces[1]


def coverage_to_opacity(alpha: Tensor, spread_px: float, most: float) -> Tensor:
    """Return the opacity of Gaussians, one per pixel, that together cover a fraction of the light.

    With one opacity o, light passes the product of 1 - o exp(-d^2 / 2 spread^2) over the pixels at distances d. This is
    solved for o.

    Args:
        alpha: Coverage, 0..1.
        spread_px: Standard deviation of the Gaussians.
        most: Largest opacity.
    """
    steps = torch.linspace(0, most, 257, dtype=torch.float64, device=alpha.device)
    offsets = torch.arange(-4, 5, dtype=torch.float64, device=alpha.device)
    squares = (offsets[:, None] ** 2 + offsets**2).flatten()
    covered = 1 - (1 - steps[:, None] * torch.exp(-squares / 2 / spread_px**2)).prod(1)
    covered = covered / covered[-1]
    above = torch.searchsorted(covered.contiguous(), alpha.double().contiguous()).clamp(1, 256)
    low, high = covered[above - 1], covered[above]
    fraction = ((alpha.double() - low) / (high - low)).clamp(0, 1)
    return (steps[above - 1] + fraction * (steps[1] - steps[0])).to(alpha)
