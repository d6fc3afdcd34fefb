"""Soft outlines: how much of each pixel beside a depth edge the near surface covers, and the colours of both."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

_RIM = 3  # pixels on either side of an edge whose colours may be mixed
_WINDOW = 6  # pixels to each side from which the colours of both surfaces are taken
_SPREAD = 3.0  # standard deviation of the weights in it, pixels
_STEP = 1.03  # ratio of disparities from which on two pixels stand one before the other
_NOISE = 2e-4  # variance of a colour, 0..1, that is no difference
_TRACE = 0.04  # coverage that is not seen


@dataclass(frozen=True)
class Matte:
    """Of the M pixels beside edges: rows, columns [M] int64; is_near bool [M], whether the depth map has the near
    surface there; alpha [M], coverage by the near surface, 0..1; near, far [M, 3], the colours of both; depth [M],
    z of the near surface."""

    rows: Tensor
    columns: Tensor
    is_near: Tensor
    alpha: Tensor
    near: Tensor
    far: Tensor
    depth: Tensor


def find_matte(image: Tensor, depth: Tensor, torn: Tensor) -> Matte:
    """The matte of the pixels beside the edges of a photo [H, W, 3] with depths z [H, W]; torn: bool [H, W], the pixels
    that have an edge to a neighbour.

    A mixed pixel is I = a F + (1 - a) B. F and B are the mean colours of the two surfaces close by, out of the band
    of mixed pixels, and a = (I - B).(F - B) / |F - B|^2. Where these colours are no farther apart than each of them
    varies, colour says nothing, and the pixel is what the depth map says: a is drawn to 0 or 1 by the ratio of the two.
    """
    disparity = (1 / depth).nan_to_num(0)
    size = 2 * _RIM + 1
    most = functional.max_pool2d(disparity[None, None], size, 1, _RIM)[0, 0]
    least = -functional.max_pool2d(-torch.where(disparity > 0, disparity, 1e30)[None, None], size, 1, _RIM)[0, 0]
    band = functional.max_pool2d(torn[None, None].float(), size - 2, 1, _RIM - 1)[0, 0] > 0
    band &= torch.isfinite(depth) & (most > _STEP * least)
    rows, columns = band.nonzero().unbind(1)
    middle = ((most + least) / 2)[rows, columns]
    is_near = disparity[rows, columns] > middle
    near, far = _surroundings(image, disparity, ~band, rows, columns, middle)
    known = (near.weight > 0) & (far.weight > 0)
    rows, columns, is_near = rows[known], columns[known], is_near[known]
    colour = image[rows, columns]
    f, b = near.mean[known], far.mean[known]
    apart = ((f - b) ** 2).sum(1)
    alpha = (((colour - b) * (f - b)).sum(1) / apart.clamp_min(1e-9)).clamp(0, 1)
    sure = apart / (apart + 4 * torch.where(is_near, near.variance[known], far.variance[known]) + _NOISE)
    hard = is_near.float()
    alpha = sure * alpha + (1 - sure) * hard
    alpha = torch.where((alpha - hard).abs() < _TRACE, hard, alpha)
    # Of each surface as much as is seen is the pixel's own, so that both together are the pixel again
    rest = (colour - alpha[:, None] * f - (1 - alpha[:, None]) * b) / (alpha**2 + (1 - alpha) ** 2)[:, None]
    own_near, own_far = (f + alpha[:, None] * rest).clamp(0, 1), (b + (1 - alpha[:, None]) * rest).clamp(0, 1)
    return Matte(rows, columns, is_near, alpha, own_near, own_far, 1 / near.disparity[known].clamp_min(1e-30))


@dataclass(frozen=True)
class _Surface:
    """Of one of the two surfaces by each pixel: weight [M], mean [M, 3] and variance [M] of its colours, disparity."""

    weight: Tensor
    mean: Tensor
    variance: Tensor
    disparity: Tensor


def _surroundings(
    image: Tensor, disparity: Tensor, clean: Tensor, rows: Tensor, columns: Tensor, middle: Tensor
) -> tuple[_Surface, _Surface]:
    """The near and the far surface close to these pixels, by its pixels that are not mixed."""
    height, width = disparity.shape
    values = torch.cat([image, (image**2).sum(2, keepdim=True), disparity[..., None]], 2).reshape(-1, 5)
    usable = torch.where(clean & (disparity > 0), disparity, torch.nan).flatten()
    sums = [image.new_zeros(len(rows), 6) for _ in range(2)]
    for down in range(-_WINDOW, _WINDOW + 1):
        for right in range(-_WINDOW, _WINDOW + 1):
            share = math.exp(-(down**2 + right**2) / 2 / _SPREAD**2)
            r, c = rows + down, columns + right
            inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
            at = r.clamp(0, height - 1) * width + c.clamp(0, width - 1)
            value, w = values[at], usable[at]
            for total, side in zip(sums, (w > middle, w <= middle)):
                own = share * (inside & side).to(value)[:, None]
                total[:, :5] += own * value
                total[:, 5:] += own
    surfaces = []
    for total in sums:
        weight = total[:, 5]
        mean = total[:, :5] / weight.clamp_min(1e-12)[:, None]
        variance = (mean[:, 3] - (mean[:, :3] ** 2).sum(1)).clamp_min(0)
        surfaces.append(_Surface(weight, mean[:, :3], variance, mean[:, 4]))
    return surfaces[0], surfaces[1]


def opacity_of_coverage(alpha: Tensor, spread_px: float, most: float) -> Tensor:
    """The opacity of Gaussians, one per pixel with this standard deviation, that together cover a share alpha, 0..1.

    Where all have the opacity o, light passes the product of 1 - o exp(-d^2 / 2 spread^2) over the pixels at distances
    d; this is solved for o, up to `most`.
    """
    steps = torch.linspace(0, most, 257, dtype=torch.float64)
    offsets = torch.arange(-4, 5, dtype=torch.float64)
    squares = (offsets[:, None] ** 2 + offsets**2).flatten()
    covered = 1 - (1 - steps[:, None] * torch.exp(-squares / 2 / spread_px**2)).prod(1)
    covered = covered / covered[-1]
    above = torch.searchsorted(covered.contiguous(), alpha.double().contiguous()).clamp(1, 256)
    low, high = covered[above - 1], covered[above]
    share = ((alpha.double() - low) / (high - low)).clamp(0, 1)
    return (steps[above - 1] + share * (steps[1] - steps[0])).to(alpha)
