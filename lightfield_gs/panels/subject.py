"""What a scene is about, where that is not all of it: far floaters, a sky, a room around an object, a capture that
reaches far beyond what it was made of.

Everything here is decided by the Gaussians that count as content (see reach.py), on a sample of a few thousand of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.base.harmonics import spiral

# The densest place of the scene
_SAMPLE = 4096  # Gaussians that are looked at
_PLACES = 128  # of these, where the densest place may be
_DENSE_SHARE = 0.1  # the densest place is the smallest ball that holds this share of the opacity

# A gap around the densest place, where a subject ends
_GAP = 2.5  # outer radius of a gap in inner ones
_IN_GAP = 0.02  # what may lie in a gap, as a share of what lies inside it
_CUT = math.sqrt(_GAP)  # where a gap is divided, in inner radii
_SMALLER = 4.0  # extent of the whole scene in inner radii, from which on the subject would be shown too small
# What lies beyond a gap is part of the subject, such as the end of a pole, if this share of the second moment of its
# directions is along one axis.
_TOWARDS_ONE_SIDE = 0.85

# A dense place that the scene surrounds
_SMALL_BALL = 0.05  # its radius in extents of the scene, up to which it is so dense that it is what was captured
_NEIGHBOURHOOD = 3.0  # how far what belongs to it reaches, in its radii
_AROUND = 0.4  # share of all directions in which there must be more of the scene for it to be surrounded
_BINS = 192  # directions that are told apart

# A shell that is closed on most sides, such as a room
_HULL_DIRECTIONS = 1024  # in which its convex hull is measured
_SHELL, _INSIDE = 0.9, 0.7  # gauges of what is the shell, from here on, and what is inside, up to here; see _Hull.gauge
# The least shares for a shell: of the surface in it, of the directions that it closes, of what counts inside it
_SHELL_SHARE, _CLOSED, _INSIDE_SHARE = 0.8, 0.8, 0.01
_SUPPORT, _STRAY = 0.995, 1.2  # the hull reaches at most _STRAY times as far out as _SUPPORT of the surface does


@dataclass(frozen=True)
class Subject:
    """The Gaussians that a scene is about, and why not all.

    inside: bool [N], which these are; None: all. why: what was found, in one line; empty: nothing that matters.
    left_out: share 0..1 of the opacity of the content that is not among them.
    """

    inside: Tensor | None = None
    why: str = ""
    left_out: float = 0.0


def find(means: Tensor, sizes: Tensor, weights: Tensor, extent: float) -> Subject:
    """The subject among Gaussians of these means [N, 3], sizes [N] and weights [N] (0: does not count).

    extent: the largest side of what would be framed otherwise, scene units.
    """
    sample = _sample(weights)
    points, sides, weight = (values[sample].cpu().double() for values in (means, sizes, weights))
    place, radius = _densest(points, weight)
    distances = (points - place).norm(dim=1)
    cut = _cut(points - place, distances, weight, radius)
    if cut is not None and _SMALLER * cut <= _CUT * extent:
        share = float(weight[distances > cut].sum() / weight.sum())
        return Subject(
            _within(means, place, cut),
            f"{share:.1%} of the scene lies far around its dense part and was left out of the framing",
            share,
        )
    if radius <= _SMALL_BALL * extent and _surrounds(points - place, distances > 2 * _NEIGHBOURHOOD * radius):
        far = distances > _NEIGHBOURHOOD * radius
        return Subject(
            _within(means, place, _NEIGHBOURHOOD * radius),
            "the scene surrounds its densest part, which was framed from within the scene",
            float(weight[far].sum() / weight.sum()),
        )
    return _in_a_shell(means, sides, points, weight)


def _within(means: Tensor, place: Tensor, radius: float) -> Tensor:
    return (means.double() - place.to(means.device)).norm(dim=1) <= radius


def _sample(weights: Tensor) -> Tensor:
    """Indices [M] of Gaussians that count, evenly among all."""
    counting = weights.nonzero()[:, 0]
    if len(counting) <= _SAMPLE:
        return counting
    return counting[torch.arange(_SAMPLE, device=counting.device) * len(counting) // _SAMPLE]


def _densest(points: Tensor, weights: Tensor) -> tuple[Tensor, float]:
    """Middle [3] and radius of the smallest ball that is centred on one of _PLACES of the points [M, 3] and holds
    _DENSE_SHARE of the weights [M]."""
    places = points[
        torch.arange(min(_PLACES, len(points)), device=points.device) * len(points) // min(_PLACES, len(points))
    ]
    distances, order = torch.cdist(places, points).sort(1)
    sums = weights[order].cumsum(1)
    index = torch.searchsorted(sums, _DENSE_SHARE * sums[:, -1:])
    radii = distances.gather(1, index)[:, 0]
    best = int(radii.argmin())
    return places[best], float(radii[best])


def _cut(offsets: Tensor, distances: Tensor, weights: Tensor, least: float) -> float | None:
    """The smallest radius from which on there is next to nothing for a while, and then more on several sides."""
    ordered, order = distances.sort()
    sums = weights[order].cumsum(0)
    beyond = torch.searchsorted(ordered, _GAP * ordered, right=True) - 1
    empty = (sums[beyond] - sums <= _IN_GAP * sums) & (ordered >= least) & (ordered > 0)
    radius = 0.0
    for index in empty.nonzero()[:, 0].tolist():
        if ordered[index] <= _GAP * radius:  # this is still the last gap
            continue
        radius = float(ordered[index])
        directions = torch.nn.functional.normalize(offsets[distances > radius], dim=1)
        if len(directions) == 0:
            return None
        if float(torch.linalg.eigvalsh(directions.T @ directions / len(directions))[-1]) <= _TOWARDS_ONE_SIDE:
            return _CUT * radius
    return None


def _surrounds(offsets: Tensor, far: Tensor) -> bool:
    """Whether those that are far, bool [M], lie in many directions."""
    return _share_of_directions(offsets[far]) >= _AROUND


def _share_of_directions(offsets: Tensor) -> float:
    """Share 0..1 of all directions in which there is one of the offsets [M, 3]."""
    if len(offsets) == 0:
        return 0.0
    bins = _directions(_BINS).to(offsets)
    return len((offsets @ bins.T).argmax(1).unique()) / _BINS


def _in_a_shell(means: Tensor, sizes: Tensor, points: Tensor, weights: Tensor) -> Subject:
    """What is inside a room: a convex hull that is closed on most sides and holds most of the surface."""
    hull = _Hull(points, sizes.square() * weights)
    gauge = hull.gauge(points)
    shell, inside = gauge > _SHELL, gauge < _INSIDE
    if (
        hull.areas[shell].sum() < _SHELL_SHARE * hull.areas.sum()
        or _share_of_directions(hull.whitened(points[shell])) < _CLOSED
    ):
        return Subject()
    kept = float(weights[inside].sum() / weights.sum())
    if kept < _INSIDE_SHARE:
        return Subject(why="the scene is a shell, closed on most sides with nothing inside: it was framed from outside")
    return Subject(
        torch.cat([hull.gauge(part.cpu()) for part in means.split(1 << 16)]).to(means.device) < _INSIDE,
        "the scene is closed on most sides, like a room: what is inside was framed, from inside",
        1 - kept,
    )


class _Hull:
    """The convex hull of a surface: how far it reaches in many directions, stretched to be as wide as deep."""

    def __init__(self, points: Tensor, areas: Tensor):
        self.areas, self.middle = areas, (areas[:, None] * points).sum(0) / areas.sum()
        offsets = points - self.middle
        spread, axes = torch.linalg.eigh((areas[:, None] * offsets).T @ offsets / areas.sum())
        self.stretch = axes / spread.clamp_min(1e-9 * float(spread[-1])).sqrt()
        self.bins = _directions(_HULL_DIRECTIONS).to(points)
        whitened = self.whitened(points)
        far, order = whitened.norm(dim=1).sort()
        sums = areas[order].cumsum(0)
        usual = far[torch.searchsorted(sums, _SUPPORT * sums[-1:]).clamp_max(len(points) - 1)]
        kept = whitened[~(whitened.norm(dim=1) > _STRAY * usual)]
        self.supports = (self.bins @ kept.T).amax(1).clamp_min(1e-9)

    def whitened(self, points: Tensor) -> Tensor:
        return (points.to(self.middle) - self.middle) @ self.stretch

    def gauge(self, points: Tensor) -> Tensor:
        """[N]: 0 in the middle to 1 on the hull (Minkowski's functional)."""
        return (self.whitened(points) @ self.bins.T / self.supports).amax(1)


def _directions(count: int) -> Tensor:
    """Unit vectors [count, 3] spread evenly over the sphere."""
    return torch.from_numpy(spiral(count))
