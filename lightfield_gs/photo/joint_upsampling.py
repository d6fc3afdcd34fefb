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


@dataclass(frozen=True)
class UpsamplingConstants:
    """Assumed depths, and radii and thresholds of the upsampling.

    All are chosen by hand and not tuned on a data set.
    """

    # near and far where the network does not know them: deep enough, with little hidden
    depth_limits: tuple[float, float] = (1.0, 1.6)
    percentiles: tuple[float, float] = (0.01, 0.99)  # of the disparities, put at far and at near
    nearer: float = 0.25  # extent of the nearest beyond near, by the range
    flat: float = 1e-4  # range of the disparities, by the largest, below which they hold no depth
    edge: float = 0.06  # range of a neighbourhood, by the map's range, from which on it has an edge
    neighbourhood_px: int = 2  # radius of the neighbourhood, pixels of the small map
    radius_px: int = 3  # radius of the votes, pixels of the small map: a square of 7 x 7
    distance_std: float = 2.0  # standard deviation of the weights by distance, pixels of the small map
    colour_std: float = 0.06  # standard deviation of the weights by colour, 0..1
    least_vote: float = 1e-6  # weight of any vote at least, so that a colour like none around still gets a depth


_C = UpsamplingConstants()


@dataclass
class Estimate:
    """The numbers of a network as disparities, and their conversion to z.

    Attributes:
        disparities: [h, w].
        value_range: Their range, > 0.
        z: Function from disparities of any shape to z, float32.
        description: See DepthMap.
        notes: See DepthMap.
    """

    disparities: Tensor
    value_range: float
    z: Callable[[Tensor], Tensor]
    description: str
    notes: list[str] = field(default_factory=list)


def disparities_to_z(
    values: Tensor, limits: tuple[float, float] | None = None, ends: tuple[float, float] | None = None
) -> Estimate:
    """Return the estimate of disparities [h, w] of unknown scale and offset.

    Args:
        values: The disparities.
        limits: near and far, None: (1, 1.6).
        ends: Disparities that are put at far and at near; None: their percentiles.
    """
    near, far = limits or _C.depth_limits
    low, high = ends or percentiles(values)
    value_range = high - low
    notes = []
    if not value_range > _C.flat * max(abs(low), abs(high)):
        value_range = 1.0
        notes.append("there is no depth in what it sees, and the scene is flat")
        values = torch.full_like(values, low)
    description = f"disparities, of which the 1st and the 99th percentile are put at z {far:g} and {near:g}"
    description += " (assumed; depth_range=)" if limits is None else ""

    def z(disparities: Tensor) -> Tensor:
        fraction = ((disparities.float() - low) / value_range).clamp(0, 1 + _C.nearer)
        return 1 / (1 / far + (1 / near - 1 / far) * fraction)

    return Estimate(values, value_range, z, description, notes)


def distances_to_z(values: Tensor) -> Estimate:
    """Return the estimate of distances [h, w]; numbers that are no distance > 0 get no depth."""
    measured = (values > 1 / FARTHEST) & (values < FARTHEST)
    # A pixel without a distance counts as infinitely far, until it is left out
    disparities = torch.where(measured, 1 / values, 0)
    low, high = percentiles(disparities)
    notes = [] if bool(measured.all()) else [f"{1 - float(measured.double().mean()):.1%} have no distance"]
    z = lambda values: torch.where(values > 1 / FARTHEST, 1 / values.float(), torch.nan)
    description = "distances"
    if bool(measured.any()):
        description += f" {float(values[measured].min()):.4g}..{float(values[measured].max()):.4g}"
    return Estimate(disparities, max(high - low, _C.flat * high, 1 / FARTHEST), z, description, notes)


def percentiles(values: Tensor) -> tuple[float, float]:
    """Return the low and the high percentile, each a value that occurs."""
    each = values.detach().ravel()
    ranks = [round(fraction * (len(each) - 1)) for fraction in _C.percentiles]
    if each.is_cuda:
        low, high = each.sort().values[ranks].tolist()
        return low, high
    low, high = (float(value) for value in np.partition(each.numpy(), ranks)[ranks])  # a tenth of the time of sorting
    return low, high


_CHUNK = 1 << 16  # pixels that are voted on at a time: 40 MB


def upsample(values: Tensor, photo: Tensor, value_range: float) -> Tensor:
    """Return a map of disparities at its photo's size, float32 [H, W], with edges where the photo has them.

    Away from edges it is bilinear. Around them, each pixel takes a weighted median of the disparities nearby. A vote
    counts more if it is near and of similar colour, and less if it lies on a soft edge itself (joint bilateral
    upsampling: Kopf et al. 2007). A weighted median makes no depth between near and far (Ma et al., "Constant time
    weighted median filtering for stereo matching and beyond", 2013). The votes that agree with the median are averaged,
    so that slopes stay smooth.

    Args:
        values: Disparities [h, w].
        photo: [H, W, 3], floats in 0..1, on the same device.
        value_range: The range of the disparities, in their unit, > 0.
    """
    size = photo.shape[:2]
    values = values.float()
    smooth = interpolate(values[None, None], size=size, mode="bilinear", align_corners=False)[0, 0]
    at_edges = _range(values, _C.neighbourhood_px) > _C.edge * value_range
    rows, columns = interpolate(at_edges[None, None].float(), size=size)[0, 0].nonzero().unbind(1)
    if not len(rows):
        return smooth
    candidates = _Voters(values, photo, _C.edge * value_range)
    result = smooth.clone()
    for start in range(0, len(rows), _CHUNK):
        row, column = rows[start : start + _CHUNK], columns[start : start + _CHUNK]
        result[row, column] = candidates.vote(row, column, photo[row, column])
    return result


def resize_to_photo(z: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Return a depth map at its photo's size, float32 [H, W], NaN where nothing was measured.

    A smaller map is brought to the photo's edges as `upsample` does. From a larger map each pixel takes the depth at
    its middle, so that no depth lies between near and far.

    Args:
        z: Distances [h, w], scene units.
        photo: [H, W, 3 or more], floats in 0..1, of the same shape.
    """
    return measured_to_photo(torch.from_numpy(z), torch.from_numpy(photo[..., :3])).numpy()


def measured_to_photo(z: Tensor, photo: Tensor) -> Tensor:
    """Return distances [h, w] at the size of a photo [H, W, 3], see resize_to_photo."""
    if z.numel() > photo.shape[0] * photo.shape[1]:
        return at_middles(z, photo)
    estimate = distances_to_z(z)
    return estimate.z(upsample(estimate.disparities, photo, estimate.value_range))


def at_middles(values: Tensor, photo: Tensor) -> Tensor:
    """Return a map [h, w] at the size of a smaller photo [H, W, 3]: each pixel takes the value at its middle."""
    down, right = (
        (torch.arange(n, device=values.device) * 2 + 1) * m // (2 * n) for n, m in zip(photo.shape[:2], values.shape)
    )
    return values[down[:, None], right]


class _Voters:
    """The pixels of the small map around each pixel of the photo."""

    def __init__(self, values: Tensor, photo: Tensor, step: float):
        self.step, self.small, self.size = step, values.shape, photo.shape[:2]
        colours = interpolate(photo.movedim(2, 0)[None], size=self.small, mode="area")[0]
        trust = step / (step + _range(values, 1))
        stacked = torch.cat([values[None], colours, trust[None]])
        # Beyond the border there are no votes: the trust there is 0
        self.padded = pad(stacked, (_C.radius_px,) * 4)
        reach = torch.arange(-_C.radius_px, _C.radius_px + 1, device=values.device)
        self.down, self.right = (part.ravel() for part in torch.meshgrid(reach, reach, indexing="ij"))

    def vote(self, rows: Tensor, columns: Tensor, colours: Tensor) -> Tensor:
        """Return the disparities [M] of pixels of the photo [M] with these colours [M, 3]."""
        y, x = ((index + 0.5) * small / size for index, small, size in zip((rows, columns), self.small, self.size))
        row, column = y.floor().long()[:, None] + self.down, x.floor().long()[:, None] + self.right
        around = self.padded[:, row + _C.radius_px, column + _C.radius_px]
        values, trust = around[0], around[4]
        apart = (around[1:4] - colours.T[:, :, None]).square().sum(0)
        far = (row + 0.5 - y[:, None]).square() + (column + 0.5 - x[:, None]).square()
        closeness = torch.exp(-apart / (2 * _C.colour_std**2) - far / (2 * _C.distance_std**2)) + _C.least_vote
        votes = trust * closeness
        median = _weighted_median(values, votes)
        votes = torch.where((values - median).abs() <= self.step / 2, votes, 0)
        return (votes * values).sum(1) / votes.sum(1)


def _weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """Return the weighted median [M, 1] of values and weights [M, K]."""
    ordered, order = values.sort(1)
    sums = weights.gather(1, order).cumsum(1)
    index = torch.searchsorted(sums, sums[:, -1:] / 2).clamp_max(values.shape[1] - 1)
    return ordered.gather(1, index)


def _range(values: Tensor, radius: int) -> Tensor:
    """Return the largest minus the smallest value of the window around each pixel, [h, w]."""
    return max_filter(values, radius) + max_filter(-values, radius)
