"""Depth maps at the size of their photo, with the photo's edges; and disparities as view-space z."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from lightfield_gs.photo.depth import FARTHEST
from lightfield_gs.photo.image_filters import max_filter

DEPTH_LIMITS = (1.0, 1.6)  # near and far where the network does not know them: deep enough, with little that is hidden
_PERCENTILES = (0.01, 0.99)  # of the disparities that are put at far and at near
_NEARER = 0.25  # by how much of the range the nearest go on beyond near
_FLAT = 1e-4  # range of the disparities, as a share of the largest, below which there is no depth in them


@dataclass
class Estimate:
    """The numbers of a network as disparities, and the way from there to z.

    disparities: [h, w]. spread: their range, > 0. z: of disparities of any shape, float32. description and notes: as in
    DepthMap.
    """

    disparities: Tensor
    spread: float
    z: Callable[[Tensor], Tensor]
    description: str
    notes: list[str] = field(default_factory=list)


def disparities_to_z(values: Tensor, limits: tuple[float, float] | None = None) -> Estimate:
    """Of disparities [h, w] of unknown scale and offset; limits: near and far, None: DEPTH_LIMITS."""
    near, far = limits or DEPTH_LIMITS
    low, high = _percentiles(values)
    spread = high - low
    notes = []
    if not spread > _FLAT * max(abs(low), abs(high)):
        spread = 1.0
        notes.append("there is no depth in what it sees, and the scene is flat")
        values = torch.full_like(values, low)
    description = f"disparities, of which the 1st and the 99th percentile are put at z {far:g} and {near:g}"

    def z(disparities: Tensor) -> Tensor:
        share = ((disparities.float() - low) / spread).clamp(0, 1 + _NEARER)
        return 1 / (1 / far + (1 / near - 1 / far) * share)

    return Estimate(values, spread, z, description + (" (assumed; --depth-range)" if limits is None else ""), notes)


def distances_to_z(values: Tensor) -> Estimate:
    """Of distances [h, w]; what is no distance > 0 gets no depth."""
    measured = (values > 1 / FARTHEST) & (values < FARTHEST)
    # The place of a pixel without a distance counts as infinitely far, until it is left out
    disparities = torch.where(measured, 1 / values, 0)
    low, high = _percentiles(disparities)
    notes = [] if bool(measured.all()) else [f"{1 - float(measured.double().mean()):.1%} have no distance"]
    z = lambda values: torch.where(values > 1 / FARTHEST, 1 / values.float(), torch.nan)
    description = "distances"
    if bool(measured.any()):
        description += f" {float(values[measured].min()):.4g}..{float(values[measured].max()):.4g}"
    return Estimate(disparities, max(high - low, _FLAT * high, 1 / FARTHEST), z, description, notes)


def _percentiles(values: Tensor) -> tuple[float, float]:
    """Those of _PERCENTILES, each a value that occurs."""
    ordered = values.ravel().sort().values
    low, high = (float(ordered[round(share * (len(ordered) - 1))]) for share in _PERCENTILES)
    return low, high


_EDGE = 0.06  # what the disparity of a neighbourhood spans where an edge is looked for, as a share of the map's range
_NEIGHBOURHOOD = 2  # pixels of the small map to each side
_RADIUS = 3  # pixels of the small map: the votes come from a square of 7 x 7
_NEAR_PX = 2.0  # standard deviation of the votes' weights by distance, in pixels of the small map
_ALIKE = 0.06  # standard deviation of the votes' weights by colour, 0..1
_LEAST_VOTE = 1e-6  # so that a colour like none around still gets a depth
_CHUNK = 1 << 16  # pixels that are voted on at a time: 40 MB


def upsample(values: Tensor, photo: Tensor, spread: float) -> Tensor:
    """A map of disparities [h, w] at its photo's size, float32 [H, W], with edges where the photo has them.

    photo: [H, W, 3], floats in 0..1, on the same device. spread: the range of the disparities, in their unit, > 0.

    Away from edges it is bilinear. Around them, each pixel takes the weighted median of the disparities nearby, a vote
    counting more the nearer it is, the more its colour is that of the pixel (joint bilateral upsampling: Kopf et al.
    2007; as a weighted median, which makes no depth between near and far: Ma et al., "Constant time weighted median
    filtering for stereo matching and beyond", 2013), and the less it lies on a soft edge itself. What agrees with the
    median is then averaged, so that slopes stay smooth.
    """
    size = photo.shape[:2]
    values = values.float()
    smooth = interpolate(values[None, None], size=size, mode="bilinear", align_corners=False)[0, 0]
    at_edges = _span(values, _NEIGHBOURHOOD) > _EDGE * spread
    rows, columns = interpolate(at_edges[None, None].float(), size=size)[0, 0].nonzero().unbind(1)
    if not len(rows):
        return smooth
    candidates = _Candidates(values, photo, _EDGE * spread)
    result = smooth.clone()
    for start in range(0, len(rows), _CHUNK):
        row, column = rows[start : start + _CHUNK], columns[start : start + _CHUNK]
        result[row, column] = candidates.elected(row, column, photo[row, column])
    return result


def resize_to_photo(z: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """A depth map [h, w] of a photo at the photo's size, float32 [H, W], NaN where nothing was measured.

    z: distances, scene units. photo: [H, W, 3 or more], floats in 0..1, of the same shape. A smaller map is brought to
    its edges as `upsample` does; of a larger one each pixel takes the depth at its middle, so that none lies between
    near and far.
    """
    (height, width), (rows, columns) = photo.shape[:2], z.shape
    if rows * columns > height * width:
        down, right = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in ((height, rows), (width, columns)))
        return z[np.ix_(down, right)]
    found = distances_to_z(torch.from_numpy(z))
    return found.z(upsample(found.disparities, torch.from_numpy(photo[..., :3]), found.spread)).numpy()


class _Candidates:
    """The pixels of the small map, by which pixel of the photo they are near."""

    def __init__(self, values: Tensor, photo: Tensor, step: float):
        self.step, self.small, self.size = step, values.shape, photo.shape[:2]
        colours = interpolate(photo.movedim(2, 0)[None], size=self.small, mode="area")[0]
        trust = step / (step + _span(values, 1))
        stacked = torch.cat([values[None], colours, trust[None]])
        # Beyond the border nobody votes: the trust there is 0
        self.padded = pad(stacked, (_RADIUS,) * 4)
        reach = torch.arange(-_RADIUS, _RADIUS + 1, device=values.device)
        self.down, self.right = (part.ravel() for part in torch.meshgrid(reach, reach, indexing="ij"))

    def elected(self, rows: Tensor, columns: Tensor, colours: Tensor) -> Tensor:
        """The disparities [M] of pixels of the photo at these places [M], with these colours [M, 3]."""
        y, x = ((place + 0.5) * small / size for place, small, size in zip((rows, columns), self.small, self.size))
        row, column = y.floor().long()[:, None] + self.down, x.floor().long()[:, None] + self.right
        around = self.padded[:, row + _RADIUS, column + _RADIUS]
        values, trust = around[0], around[4]
        apart = (around[1:4] - colours.T[:, :, None]).square().sum(0)
        far = (row + 0.5 - y[:, None]).square() + (column + 0.5 - x[:, None]).square()
        closeness = torch.exp(-apart / (2 * _ALIKE**2) - far / (2 * _NEAR_PX**2)) + _LEAST_VOTE
        votes = trust * closeness
        median = _weighted_median(values, votes)
        votes = torch.where((values - median).abs() <= self.step / 2, votes, 0)
        return (votes * values).sum(1) / votes.sum(1)


def _weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """[M, 1], of values and weights [M, K]."""
    ordered, order = values.sort(1)
    sums = weights.gather(1, order).cumsum(1)
    index = torch.searchsorted(sums, sums[:, -1:] / 2).clamp_max(values.shape[1] - 1)
    return ordered.gather(1, index)


def _span(values: Tensor, radius: int) -> Tensor:
    """Largest minus smallest of the 2 radius + 1 by 2 radius + 1 pixels around each, [h, w]."""
    return max_filter(values, radius) + max_filter(-values, radius)
