"""Depth at the size of its photo, from a smaller map whose edges are soft: what goes where, the photo's colours say."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from lightfield_gs.photo.joint_upsampling import z_of_distances
from lightfield_gs.photo.image_filters import largest

_EDGE = 0.06  # what the disparity of a neighbourhood spans where an edge is looked for, as a share of the map's range
_NEIGHBOURHOOD = 2  # pixels of the small map to each side
_RADIUS = 3  # pixels of the small map: the votes come from a square of 7 x 7
_NEAR_PX = 2.0  # standard deviation of the votes' weights by distance, in pixels of the small map
_ALIKE = 0.06  # standard deviation of the votes' weights by colour, 0..1
_LEAST_VOTE = 1e-6  # so that a colour like none around still gets a depth
_CHUNK = 1 << 16  # pixels that are voted on at a time: 40 MB


def upsampled(values: Tensor, photo: Tensor, spread: float) -> Tensor:
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


def at_size_of_photo(z: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """A depth map [h, w] of a photo at the photo's size, float32 [H, W], NaN where nothing was measured.

    z: distances, scene units. photo: [H, W, 3 or more], floats in 0..1, of the same shape. A smaller map is brought to
    its edges as `upsampled` does; of a larger one each pixel takes the depth at its middle, so that none lies between
    near and far.
    """
    (height, width), (rows, columns) = photo.shape[:2], z.shape
    if rows * columns > height * width:
        down, right = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in ((height, rows), (width, columns)))
        return z[np.ix_(down, right)]
    found = z_of_distances(torch.from_numpy(z))
    return found.z(upsampled(found.disparities, torch.from_numpy(photo[..., :3]), found.spread)).numpy()


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
    return largest(values, radius) + largest(-values, radius)
