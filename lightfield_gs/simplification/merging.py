"""Merging of Gaussians by pairs, in the order of the error that a merge brings to the light field.

A scene is a graph: Gaussians, and edges between near neighbours on the panel, where the distance counts the parallax
over the eyes. An edge costs the squared error of the image when its ends merge, a Gaussian the squared error when it is
dropped. The cheapest go first, in rounds; an edge merges where it is the cheapest of both ends.

Visible weights w (the sum over the image of alpha times transmittance) take occlusion into account. The mean and the
covariance of a merged Gaussian are the moments of the mixture by w. Its colour is the mean by w. Its opacity times its
area is the sum over both, less the part of one that is far more hidden than the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.scene.gaussians import Gaussians, from_tensors
from lightfield_gs.scene.rotation import rotation_quaternions
from lightfield_gs.simplification.footprints import Footprints, Viewpoints, camera_moments, overlap

# These were chosen on two captures, a guitar at a fourth of its Gaussians and playbot at half; a biker reports them.
NEIGHBOURS = 8
_CONTRAST = 0.2  # of a Gaussian against what is behind and beside it: most is like its surroundings
_HIDDEN = 0.01  # weight of what nobody sees, relative to the same in view: geometry needs a weight
_MOST_OPAQUE = 0.995
_FADE = 0.5  # of the transmittance before the nearer one; below it a mass counts in proportion
_ROUND = 0.2  # fraction of the possible merges, the cheapest, that one round makes
_BLOCK = 1 << 20  # edges at a time: bounds the memory of the costs
_EIGENSYSTEMS = 1 << 14  # at a time: cuSOLVER takes some kB of memory for each, and fails with half a million
_LEAST = 1e-12


@dataclass(frozen=True)
class Mixture:
    """N Gaussians in the axes of the images, and the visible part of each, float32.

    Attributes:
        means: [N,3].
        covariances: [N,6]: xx, xy, xz, yy, yz, zz.
        opacities: [N].
        colours: [N,3], of harmonics of degree 0.
        weights: [N], the visible part: px of an opaque image.
        masses: [N], opacity times area: what the weight would be without others before it, px.
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    colours: Tensor
    weights: Tensor
    masses: Tensor

    def take(self, indices: Tensor) -> Mixture:
        """Return some of the Gaussians."""
        return Mixture(*(tensor[indices] for tensor in vars(self).values()))

    def transmittance(self) -> Tensor:
        """Return [N], the mean transmittance before each Gaussian, above 0."""
        return (self.weights / self.masses.clamp_min(_LEAST)).clamp(1e-6, 1)

    def geometric_weights(self) -> Tensor:
        """Return [N], the weights of the moments."""
        return self.weights + _HIDDEN * self.masses + _LEAST


def merge_moments(a: Mixture, b: Mixture, eyes: Viewpoints) -> tuple[Mixture, Footprints, Tensor]:
    """Return the merged pairs, their footprints, and the mass [N] that an opacity of at most 1 cannot hold."""
    first = a.geometric_weights()
    share = (b.geometric_weights() / (first + b.geometric_weights()))[:, None]
    offset = b.means - a.means
    i, j = torch.triu_indices(3, 3, device=offset.device)
    spread = offset[:, i] * offset[:, j]
    means = a.means + share * offset
    covariances = a.covariances + share * (b.covariances - a.covariances) + share * (1 - share) * spread
    footprints = eyes.project(means, covariances)
    weights, area = a.weights + b.weights, footprints.area()
    before_a, before_b = a.transmittance(), b.transmittance()
    nearer = torch.maximum(before_a, before_b)
    mass = a.masses * _shown(before_a, nearer) + b.masses * _shown(before_b, nearer)
    opacities = (mass / area).clamp_max(_MOST_OPAQUE)
    held = opacities * area
    colours = a.colours + share * (b.colours - a.colours)
    return Mixture(means, covariances, opacities, colours, weights, held), footprints, mass - held


def _shown(before: Tensor, nearer: Tensor) -> Tensor:
    """Return [N], 0..1, how much of a mass counts: less where it is far more hidden than the other of its pair."""
    return (before / nearer / _FADE).clamp_max(1)


def merge_costs(a: Mixture, b: Mixture, print_a: Footprints, print_b: Footprints, eyes: Viewpoints) -> Tensor:
    """Return [N], the squared errors of the image by merges, summed over pixels and channels.

    The first part is the difference of colours, which the merged Gaussian spreads over both. The second is the
    difference of shapes, times the contrast.
    """
    merged, shape, lost = merge_moments(a, b, eyes)
    aa, bb, ab = overlap(print_a, print_a), overlap(print_b, print_b), overlap(print_a, print_b)
    both = merged.weights.clamp_min(_LEAST)
    mixed = (a.weights * b.weights / both).square() * (aa + bb - 2 * ab)
    difference = (a.colours - b.colours).square().sum(-1)
    whole = both * (
        both * overlap(shape, shape) - 2 * (a.weights * overlap(print_a, shape) + b.weights * overlap(print_b, shape))
    )
    parts = a.weights.square() * aa + b.weights.square() * bb + 2 * a.weights * b.weights * ab
    missing = (lost * merged.transmittance()).square() / shape.area()
    return mixed * difference + 3 * _CONTRAST**2 * ((whole + parts).clamp_min(0) + missing)


def drop_costs(mixture: Mixture, footprints: Footprints) -> Tensor:
    """Return [N], the squared error of the image by the loss of each Gaussian."""
    return 3 * _CONTRAST**2 * mixture.weights.square() * overlap(footprints, footprints)


class MergedScene:
    """A scene that becomes smaller by `reduce`.

    Attributes:
        gaussians: the whole scene.
        labels: [N] int64, the merged Gaussian that each has become a part of; -1 where it is dropped.
        mixture: the merged Gaussians.
    """

    def __init__(self, gaussians: Gaussians, weights: Tensor, eyes: Viewpoints) -> None:
        """Begin with the Gaussians that show.

        Args:
            gaussians: the scene, float32.
            weights: [N], visible weights, px of an opaque image.
            eyes: the images that judge.
        """
        self.gaussians, self._eyes = gaussians, eyes
        means, covariances = camera_moments(gaussians, eyes)
        footprints = eyes.project(means, covariances)
        colours = (0.5 + SH_CONSTANT * gaussians.sh[:, 0]).clamp_min(0)
        area, weights = footprints.area(), weights.float()
        masses = torch.maximum(gaussians.opacities * area, weights)
        whole = Mixture(means, covariances, gaussians.opacities, colours, weights, masses)
        kept = (weights > 0).nonzero()[:, 0]
        self.labels = torch.full((gaussians.count,), -1, device=weights.device)
        self.labels[kept] = torch.arange(len(kept), device=weights.device)
        self.mixture, self._footprints = whole.take(kept), footprints.take(kept)
        self._shares = whole.geometric_weights()
        self._is_merged = torch.zeros(len(kept), dtype=torch.bool, device=weights.device)
        self._edges = _nearest(eyes.places(self.mixture.means))
        self._costs = self._edge_costs(self._edges)

    @property
    def count(self) -> int:
        """The number of merged Gaussians."""
        return len(self.mixture.opacities)

    def copy(self) -> MergedScene:
        """Return a scene that may be reduced by itself; tensors are never changed in place, so they are shared."""
        other = object.__new__(MergedScene)
        vars(other).update(vars(self))
        return other

    def reduce(self, target: int) -> None:
        """Merge and drop until `target` Gaussians are left, or nothing can go."""
        while self.count > target and self._round(target):
            pass

    def _round(self, target: int) -> bool:
        """Merge and drop the cheapest; return whether there were any."""
        count, device = self.count, self.labels.device
        drops = drop_costs(self.mixture, self._footprints)
        ends, best = self._edges, drops.clone()
        for end in ends:
            best.scatter_reduce_(0, end, self._costs, "amin")
        cheapest = (self._costs <= best[ends[0]]) & (self._costs <= best[ends[1]]) & self._costs.isfinite()
        pairs, going = cheapest.nonzero()[:, 0], ((drops <= best) & drops.isfinite()).nonzero()[:, 0]
        costs = torch.cat([self._costs[pairs], drops[going]])
        if len(costs) == 0:
            return False
        chosen = costs.argsort(stable=True)[: min(count - target, int(_ROUND * len(costs)) + 1)]
        pairs, going = pairs[chosen[chosen < len(pairs)]], going[chosen[chosen >= len(pairs)] - len(pairs)]
        taken = torch.full((count,), -1, device=device)  # of edges of equal cost at one end, one merges
        order = torch.arange(len(pairs), device=device)
        for end in ends[:, pairs]:
            taken.scatter_reduce_(0, end, order, "amax")
        pairs = pairs[(taken[ends[0, pairs]] == order) & (taken[ends[1, pairs]] == order)]
        self._apply(ends[0, pairs], ends[1, pairs], going)
        return True

    def _apply(self, first: Tensor, second: Tensor, dropped: Tensor) -> None:
        """Merge each second into its first, and drop others."""
        count, device, mixture = self.count, self.labels.device, self.mixture
        merged, footprints, _ = merge_moments(mixture.take(first), mixture.take(second), self._eyes)
        target = torch.arange(count, device=device)
        target[second], target[dropped] = first, -1
        kept = target == torch.arange(count, device=device)
        renumbered = (kept.cumsum(0) - 1).masked_fill(~kept, -1)
        target = torch.where(target < 0, -1, renumbered[target])  # renumbered[-1] is not used
        place = renumbered[first]
        self.mixture = Mixture(
            *(_replaced(old[kept], place, new) for old, new in zip(vars(mixture).values(), vars(merged).values()))
        )
        old, new = vars(self._footprints).values(), vars(footprints).values()
        self._footprints = Footprints(*(_replaced(a[kept], place, b) for a, b in zip(old, new)))
        is_new = torch.zeros(self.count, dtype=torch.bool, device=device)
        is_new[place] = True
        self._is_merged = self._is_merged[kept] | is_new
        self.labels = torch.where(self.labels < 0, -1, target[self.labels])
        edges, costs = _contracted(target[self._edges], self._costs, self.count)
        stale = (is_new[edges[0]] | is_new[edges[1]]).nonzero()[:, 0]
        self._edges, self._costs = edges, costs.index_copy(0, stale, self._edge_costs(edges[:, stale]))

    def _edge_costs(self, edges: Tensor) -> Tensor:
        costs = [
            merge_costs(
                self.mixture.take(a),
                self.mixture.take(b),
                self._footprints.take(a),
                self._footprints.take(b),
                self._eyes,
            )
            for a, b in zip(edges[0].split(_BLOCK), edges[1].split(_BLOCK))
        ]
        return torch.cat(costs) if costs else self._costs[:0]

    def scene(self) -> Gaussians:
        """Return the merged Gaussians in world axes; those that no merge has changed keep their bits."""
        source, eyes, mixture = self.gaussians, self._eyes, self.mixture
        seen = (self.labels >= 0).nonzero()[:, 0]
        labels, shares = self.labels[seen], self._shares[seen]
        total = torch.zeros(self.count, device=shares.device).index_add_(0, labels, shares)
        harmonics = torch.zeros(self.count, *source.sh.shape[1:], device=shares.device)
        for block in torch.arange(len(seen), device=seen.device).split(_BLOCK):
            part = (shares[block] / total[labels[block]])[:, None, None] * source.sh[seen[block]]
            harmonics.index_add_(0, labels[block], part)
        origin = torch.zeros(self.count, dtype=torch.int64, device=seen.device).index_copy_(0, labels, seen)
        kept = [tensor[origin] for tensor in (source.means, source.quaternions, source.scales, source.opacities)]
        new = self._is_merged.nonzero()[:, 0]
        scales, quaternions = _axes(mixture.covariances[new], eyes.rotation)
        means = (mixture.means[new] - eyes.translation) @ eyes.rotation
        made = (means, quaternions, scales, mixture.opacities[new])
        fields = [_replaced(old, new, some) for old, some in zip(kept, made)]
        unchanged = (~self._is_merged).nonzero()[:, 0]
        harmonics = _replaced(harmonics, unchanged, source.sh[origin[unchanged]])
        return replace(from_tensors([*fields, harmonics]), origin=source.origin)


def _axes(covariances: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
    """Return standard deviations [N,3] and quaternions [N,4] in world axes of covariances [N,6] in camera axes."""
    rows = torch.tensor([0, 1, 2, 1, 3, 4, 2, 4, 5], device=covariances.device)
    matrices = covariances.double()[:, rows].reshape(-1, 3, 3)
    systems = zip(*(torch.linalg.eigh(part) for part in matrices.split(_EIGENSYSTEMS)))
    variances, axes = (torch.cat(parts) for parts in systems)
    axes = rotation.double().T @ axes
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    least = (1e-8 * variances[:, 2:]).clamp_min(1e-24)  # rounding of the sums may leave less than nothing
    return variances.clamp_min(least).sqrt().float(), rotation_quaternions(axes).float()


def _replaced(values: Tensor, indices: Tensor, new: Tensor) -> Tensor:
    return values.index_copy(0, indices, new.to(values.dtype))


def _nearest(places: Tensor) -> Tensor:
    """Return edges [2,E] between each of N places [N,3] and its nearest neighbours, each edge once."""
    count = len(places)
    if count < 2:
        return torch.zeros(2, 0, dtype=torch.int64, device=places.device)
    points = places.cpu().numpy()
    _, found = cKDTree(points, balanced_tree=False, compact_nodes=False).query(
        points, min(NEIGHBOURS + 1, count), workers=-1
    )
    ends = torch.from_numpy(np.stack([np.repeat(np.arange(count), found.shape[1]), found.reshape(-1)]))
    edges, _ = _contracted(ends.to(places.device), torch.zeros(ends.shape[1], device=places.device), count)
    return edges


def _contracted(edges: Tensor, costs: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return edges [2,E] and costs without doubles, loops and those with an end of -1."""
    low, high = torch.minimum(edges[0], edges[1]), torch.maximum(edges[0], edges[1])
    kept = (low >= 0) & (low < high)
    keys, order = (low[kept] * count + high[kept]).sort(stable=True)
    first = torch.ones_like(keys, dtype=torch.bool)
    first[1:] = keys[1:] != keys[:-1]
    keys = keys[first]
    return torch.stack([keys // count, keys % count]), costs[kept][order[first]]
