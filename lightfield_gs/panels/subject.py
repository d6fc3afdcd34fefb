"""The subject of a scene where it is not the whole scene: far floaters, a sky, a room around an object, a wide capture.

The Gaussians that count as content decide (see extent.py), by a sample of a few thousand of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.base.harmonics import spiral


@dataclass(frozen=True)
class SubjectConstants:
    """Thresholds of the subject.

    All are chosen by hand and not tuned on a data set; tests/panels/test_subject.py has the scenes that they must tell
    apart.
    """

    # The densest place of the scene
    sample: int = 4096  # Gaussians that are looked at
    centres: int = 128  # of these, the centres that are tried for the densest ball
    dense_fraction: float = 0.1  # the densest place is the smallest ball that holds this fraction of the opacity

    # A gap around the densest place, where a subject ends
    gap_ratio: float = 2.5  # outer radius of a gap by its inner one
    in_gap: float = 0.02  # largest weight in a gap, as a fraction of the weight inside it
    # extent of the scene in inner radii from which on the whole would show its subject too small
    small_ratio: float = 4.0
    # fraction of the second moment of directions along one axis. From it on the rest is part of the subject, such as
    # the end of a pole
    one_sided: float = 0.85

    # A dense place that the scene surrounds
    small_ball: float = 0.05  # radius of the ball, in extents of the scene, up to which it is the captured object
    neighbourhood: float = 3.0  # reach of the subject, in radii of the ball
    around: float = 0.4  # fraction of all directions with more of the scene from which on it surrounds the ball
    direction_bins: int = 192  # directions that are told apart

    # A shell that is closed on most sides, such as a room
    hull_directions: int = 1024  # directions in which the convex hull is measured
    shell_gauge: float = 0.9  # gauge from which on a Gaussian is part of the shell, see _Hull.gauge
    inside_gauge: float = 0.7  # gauge up to which a Gaussian is inside
    shell_fraction: float = 0.8  # least fraction of the surface in the shell
    closed_fraction: float = 0.8  # least fraction of directions that the shell closes
    inside_fraction: float = 0.01  # least fraction of the weight inside the shell
    support_quantile: float = 0.995  # quantile of the surface's distances that the hull is measured by
    stray_ratio: float = 1.2  # distance by that quantile beyond which the hull leaves surface out


_C = SubjectConstants()


@dataclass(frozen=True)
class Subject:
    """The Gaussians of a scene's subject, and the reason why they are not all.

    Attributes:
        inside: bool [N], which Gaussians these are; None: all.
        reason: The finding, in one line; empty where the subject is the whole scene.
        left_out: Fraction 0..1 of the content's opacity that is left out.
    """

    inside: Tensor | None = None
    reason: str = ""
    left_out: float = 0.0


def find_subject(means: Tensor, sizes: Tensor, weights: Tensor, extent: float) -> Subject:
    """Find the subject among Gaussians.

    Args:
        means: [N, 3], scene units.
        sizes: [N], a standard deviation of each, scene units.
        weights: [N], 0 for a Gaussian that does not count.
        extent: The largest side of the whole content, scene units.
    """
    sample = _spread(weights.nonzero()[:, 0], _C.sample)
    points, sides, weight = (values[sample].cpu().double() for values in (means, sizes, weights))
    place, radius = _densest(points, weight)
    distances = (points - place).norm(dim=1)
    cut = _cut(points - place, distances, weight, radius)
    if cut is not None and _C.small_ratio * cut <= math.sqrt(_C.gap_ratio) * extent:
        fraction = float(weight[distances > cut].sum() / weight.sum())
        reason = f"{fraction:.1%} of the scene lies far around its dense part and was left out of the framing"
        return Subject(_within(means, place, cut), reason, fraction)
    reach = _C.neighbourhood * radius
    around = (points - place)[distances > 2 * reach]
    if radius <= _C.small_ball * extent and _direction_fraction(around) >= _C.around:
        reason = "the scene surrounds its densest part, which was framed from within the scene"
        fraction = float(weight[distances > reach].sum() / weight.sum())
        return Subject(_within(means, place, reach), reason, fraction)
    return _find_in_shell(means, sides, points, weight)


def _within(means: Tensor, place: Tensor, radius: float) -> Tensor:
    """Return which means [N, 3] lie in a ball, bool [N]."""
    return (means.double() - place.to(means.device)).norm(dim=1) <= radius


def _spread(values: Tensor, most: int) -> Tensor:
    """Return at most so many of the values [N, ...], evenly among them."""
    count = min(most, len(values))
    return values[torch.arange(count, device=values.device) * len(values) // count]


def _densest(points: Tensor, weights: Tensor) -> tuple[Tensor, float]:
    """Return centre [3] and radius of the smallest ball with the dense fraction of the weights.

    Args:
        points: [M, 3], of which some are tried as centres.
        weights: [M].
    """
    places = _spread(points, _C.centres)
    distances, order = torch.cdist(places, points).sort(1)
    sums = weights[order].cumsum(1)
    index = torch.searchsorted(sums, _C.dense_fraction * sums[:, -1:])
    radii = distances.gather(1, index)[:, 0]
    best = int(radii.argmin())
    return places[best], float(radii[best])


def _cut(offsets: Tensor, distances: Tensor, weights: Tensor, least: float) -> float | None:
    """Return the radius of a gap around the densest place with more beyond it on several sides; None without one."""
    ordered, order = distances.sort()
    sums = weights[order].cumsum(0)
    beyond = torch.searchsorted(ordered, _C.gap_ratio * ordered, right=True) - 1
    empty = (sums[beyond] - sums <= _C.in_gap * sums) & (ordered >= least) & (ordered > 0)
    radius = 0.0
    for index in empty.nonzero()[:, 0].tolist():
        if ordered[index] <= _C.gap_ratio * radius:  # this is still the last gap
            continue
        radius = float(ordered[index])
        directions = torch.nn.functional.normalize(offsets[distances > radius], dim=1)
        if len(directions) == 0:
            return None
        if float(torch.linalg.eigvalsh(directions.T @ directions / len(directions))[-1]) <= _C.one_sided:
            return math.sqrt(_C.gap_ratio) * radius
    return None


def _direction_fraction(offsets: Tensor) -> float:
    """Return the fraction 0..1 of all directions with one of the offsets [M, 3] in them."""
    if len(offsets) == 0:
        return 0.0
    bins = _directions(_C.direction_bins).to(offsets)
    return len((offsets @ bins.T).argmax(1).unique()) / _C.direction_bins


def _find_in_shell(means: Tensor, sizes: Tensor, points: Tensor, weights: Tensor) -> Subject:
    """Return what is inside a room: a convex hull, closed on most sides, with most of the surface in it."""
    hull = _Hull(points, sizes.square() * weights)
    gauge = hull.gauge(points)
    shell, inside = gauge > _C.shell_gauge, gauge < _C.inside_gauge
    if (
        hull.areas[shell].sum() < _C.shell_fraction * hull.areas.sum()
        or _direction_fraction(hull.whitened(points[shell])) < _C.closed_fraction
    ):
        return Subject()
    kept = float(weights[inside].sum() / weights.sum())
    if kept < _C.inside_fraction:
        return Subject(
            reason="the scene is a shell, closed on most sides with nothing inside: it was framed from outside"
        )
    gauges = torch.cat([hull.gauge(part.cpu()) for part in means.split(1 << 16)]).to(means.device)
    reason = "the scene is closed on most sides, like a room: what is inside was framed, from inside"
    return Subject(gauges < _C.inside_gauge, reason, 1 - kept)


class _Hull:
    """The convex hull of a surface: its reach in many directions, stretched to be as wide as deep."""

    def __init__(self, points: Tensor, areas: Tensor):
        self.areas, self.middle = areas, (areas[:, None] * points).sum(0) / areas.sum()
        offsets = points - self.middle
        spread, axes = torch.linalg.eigh((areas[:, None] * offsets).T @ offsets / areas.sum())
        self.stretch = axes / spread.clamp_min(1e-9 * float(spread[-1])).sqrt()
        self.bins = _directions(_C.hull_directions).to(points)
        whitened = self.whitened(points)
        far, order = whitened.norm(dim=1).sort()
        sums = areas[order].cumsum(0)
        usual = far[torch.searchsorted(sums, _C.support_quantile * sums[-1:]).clamp_max(len(points) - 1)]
        kept = whitened[~(whitened.norm(dim=1) > _C.stray_ratio * usual)]
        self.supports = (self.bins @ kept.T).amax(1).clamp_min(1e-9)

    def whitened(self, points: Tensor) -> Tensor:
        """Return points [N, 3] in the stretched coordinates of the hull."""
        return (points.to(self.middle) - self.middle) @ self.stretch

    def gauge(self, points: Tensor) -> Tensor:
        """Return Minkowski's functional [N]: 0 in the middle to 1 on the hull."""
        return (self.whitened(points) @ self.bins.T / self.supports).amax(1)


def _directions(count: int) -> Tensor:
    """Return unit vectors [count, 3] spread evenly over the sphere."""
    return torch.from_numpy(spiral(count))
