"""The content of a scene, by robust statistics on any device: which Gaussians count, how far they reach, the subject.

The subject is not always the whole scene: there are far floaters, a sky, a room around an object, a wide capture. A
sample of a few thousand Gaussians of the content decides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.harmonics import spiral
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


_EXTENT, _SUBJECT = ExtentConstants(), SubjectConstants()

_NEAR = _core.NEAR_DEPTH
_ENOUGH = 20_000  # Gaussians that measure the extent well enough for a search
_MANY = 1 << 17  # Gaussians that measure it to a thousandth or two


# The extent


def content_extent(gaussians: Gaussians, world_to_camera: Tensor | None = None) -> Tensor:
    """Return left, right (x/z), top, bottom (y/z), near and far of the content, and its weight: [7].

    The edges are robust, see Rig.frame. The weight is the opacity in front of the camera. Nothing here waits
    for a device.

    Args:
        gaussians: One set.
        world_to_camera: [4, 4]; None: the Gaussians are in the camera's axes.
    """
    points, sizes, weights = gaussians.means, _middle_scales(gaussians), _weights(gaussians)
    if world_to_camera is not None:
        points = points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    depths = points[:, 2]
    weights = weights * (depths > _NEAR)
    depths = depths.clamp_min(_NEAR)
    # All rows are sorted at once: on a GPU the launches of a sort take longer than its numbers
    sides = _sides((points[:, :2] / depths[:, None]).T, sizes / depths)
    ordered, cumulative = _ordered(torch.cat([sides, depths[None]]), weights)
    edges = _bounds(ordered[:-1], cumulative[:-1])
    near, far = _percentiles(ordered[-1:], cumulative[-1:], (_EXTENT.depth_tail, 1 - _EXTENT.depth_tail))
    return torch.cat([edges.flatten(), near, far, weights.sum()[None]])


def content_bounds(gaussians: Gaussians, turn: Tensor | None = None) -> Tensor:
    """Return robust bounds [3, 2] (low, high) of the content.

    Args:
        gaussians: One set.
        turn: A rotation [3, 3] into the axes of the bounds; None: the world's.
    """
    means = gaussians.means if turn is None else gaussians.means @ turn.T
    return _bounds(*_ordered(_sides(means.T, _middle_scales(gaussians)), _weights(gaussians)))


def subsample(gaussians: Gaussians) -> Gaussians:
    """Return some of the Gaussians, enough to measure their extent."""
    return select(gaussians, slice(None, None, 1 + len(gaussians.means) // _ENOUGH))


def photo_extent(gaussians: Gaussians) -> Tensor:
    """Return the content_extent of a photo's Gaussians, in the photo's axes; of a million an eighth is enough.

    Of more than 2^17 Gaussians only some are measured.
    """
    return content_extent(_at_most(gaussians, _MANY))


def select(gaussians: Gaussians, which: Tensor | slice) -> Gaussians:
    """Return the Gaussians that `which` selects: a slice, bool [N], or indices."""
    return from_tensors(field[which] for field in gaussians.fields().values())


def thinned(gaussians: Gaussians, most: int) -> Gaussians:
    """Return at most so many Gaussians of one set, larger by as much, so that they cover about the same area."""
    some = _at_most(gaussians, most)
    if some is gaussians:
        return gaussians
    return replace(some, scales=some.scales * math.sqrt(gaussians.count / some.count))


def _at_most(gaussians: Gaussians, most: int) -> Gaussians:
    """Return one of every few Gaussians in storage, at most so many.

    A hash chooses it, so that columns and rows of a grid are met alike. Their number alone decides which ones; nothing
    waits for a device.
    """
    few = -(-gaussians.count // most)
    if few <= 1:
        return gaussians
    index = torch.arange(gaussians.count // few, device=gaussians.device)
    # Knuth's multiplicative hash, The Art of Computer Programming, vol. 3, section 6.4
    return select(gaussians, few * index + (index * 2654435761 >> 16) % few)


def _middle_scales(gaussians: Gaussians) -> Tensor:
    """Return the middle standard deviation of each Gaussian, [N]."""
    a, b, c = gaussians.scales.unbind(1)
    return torch.maximum(torch.minimum(a, b), torch.minimum(torch.maximum(a, b), c))


def _weights(gaussians: Gaussians) -> Tensor:
    """Return the opacities [N] of the Gaussians that make up the scene, 0 for haze.

    The usual opacity depends on the scene's maker. Gaussians too faint to be drawn do not count, unless all are: a
    scene without them must give the same weights.
    """
    opacities = gaussians.opacities.clamp_min(_EXTENT.least_weight)
    visible = opacities >= OPACITY_CUT
    opacities = torch.where(visible | ~visible.any(), opacities, 0)
    usual = opacities.double().square().sum() / opacities.double().sum()
    return torch.where(opacities >= _EXTENT.haze * usual, opacities, 0)


def _sides(centres: Tensor, radii: Tensor) -> Tensor:
    """Return the low sides [D, N] of balls, and after them the negated high ones: the outermost of each are the least.

    Args:
        centres: [D, N].
        radii: [N].
    """
    return torch.cat([centres - radii, -centres - radii])


def _bounds(ordered: Tensor, cumulative: Tensor) -> Tensor:
    """Return robust bounds [D, 2] (low, high) of balls, from their sides as _ordered sorts them."""
    rest, *tails = _percentiles(ordered, cumulative, _EXTENT.tails)  # [2 D] each
    low, high = rest.chunk(2)
    extent = (-high - low).repeat(2)
    bounds = rest - _EXTENT.margin * extent
    for tail in tails:  # farther and farther out
        bounds = torch.where(rest - tail <= _EXTENT.far * extent, tail, bounds)
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


# The subject


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


def find_subject(gaussians: Gaussians) -> Subject:
    """Find the subject among Gaussians.

    Args:
        gaussians: One set.
    """
    low, high = content_bounds(subsample(gaussians)).unbind(1)
    extent = float((high - low).max())
    means, weights = gaussians.means, _weights(gaussians)
    sample = _spread(weights.nonzero()[:, 0], _SUBJECT.sample)
    points, sides, weight = (values[sample].cpu().double() for values in (means, _middle_scales(gaussians), weights))
    place, radius = _densest(points, weight)
    distances = (points - place).norm(dim=1)
    cut = _cut(points - place, distances, weight, radius)
    if cut is not None and _SUBJECT.small_ratio * cut <= math.sqrt(_SUBJECT.gap_ratio) * extent:
        fraction = float(weight[distances > cut].sum() / weight.sum())
        reason = f"{fraction:.1%} of the scene lies far around its dense part and was left out of the framing"
        return Subject(_within(means, place, cut), reason, fraction)
    reach = _SUBJECT.neighbourhood * radius
    around = _direction_fraction((points - place)[distances > 2 * reach])
    if radius <= _SUBJECT.small_ball * extent and around >= _SUBJECT.around:
        reason = "the scene surrounds its densest part, which was framed from within the scene"
        return Subject(_within(means, place, reach), reason, float(weight[distances > reach].sum() / weight.sum()))
    return _find_in_shell(means, sides, points, weight)


def _within(means: Tensor, place: Tensor, radius: float) -> Tensor:
    """Return which means [N, 3] lie in a ball, bool [N]."""
    return (means.double() - place.to(means.device)).norm(dim=1) <= radius


def _spread(values: Tensor, most: int) -> Tensor:
    """Return at most this number of the values [N, ...], evenly spaced."""
    count = min(most, len(values))
    return values[torch.arange(count, device=values.device) * len(values) // count]


def _densest(points: Tensor, weights: Tensor) -> tuple[Tensor, float]:
    """Return centre [3] and radius of the smallest ball with the dense fraction of the weights.

    Args:
        points: [M, 3]; some are tried as centres.
        weights: [M].
    """
    places = _spread(points, _SUBJECT.centres)
    distances, order = torch.cdist(places, points).sort(1)
    sums = weights[order].cumsum(1)
    index = torch.searchsorted(sums, _SUBJECT.dense_fraction * sums[:, -1:])
    radii = distances.gather(1, index)[:, 0]
    best = int(radii.argmin())
    return places[best], float(radii[best])


def _cut(offsets: Tensor, distances: Tensor, weights: Tensor, least: float) -> float | None:
    """Return the radius of a gap around the densest place with more beyond it on several sides; None without one."""
    ordered, order = distances.sort()
    sums = weights[order].cumsum(0)
    beyond = torch.searchsorted(ordered, _SUBJECT.gap_ratio * ordered, right=True) - 1
    empty = (sums[beyond] - sums <= _SUBJECT.in_gap * sums) & (ordered >= least) & (ordered > 0)
    radius = 0.0
    for index in empty.nonzero()[:, 0].tolist():
        if ordered[index] <= _SUBJECT.gap_ratio * radius:  # this is still the last gap
            continue
        radius = float(ordered[index])
        directions = torch.nn.functional.normalize(offsets[distances > radius], dim=1)
        if len(directions) == 0:
            return None
        if float(torch.linalg.eigvalsh(directions.T @ directions / len(directions))[-1]) <= _SUBJECT.one_sided:
            return math.sqrt(_SUBJECT.gap_ratio) * radius
    return None


def _direction_fraction(offsets: Tensor) -> float:
    """Return the fraction 0..1 of all directions that contain an offset of [M, 3]."""
    if len(offsets) == 0:
        return 0.0
    bins = _directions(_SUBJECT.direction_bins).to(offsets)
    return len((offsets @ bins.T).argmax(1).unique()) / _SUBJECT.direction_bins


def _find_in_shell(means: Tensor, sizes: Tensor, points: Tensor, weights: Tensor) -> Subject:
    """Return the subject inside a room: a convex hull, closed on most sides, that holds most of the surface."""
    hull = _Hull(points, sizes.square() * weights)
    gauge = hull.gauge(points)
    shell, inside = gauge > _SUBJECT.shell_gauge, gauge < _SUBJECT.inside_gauge
    if (
        hull.areas[shell].sum() < _SUBJECT.shell_fraction * hull.areas.sum()
        or _direction_fraction(hull.whitened(points[shell])) < _SUBJECT.closed_fraction
    ):
        return Subject()
    kept = float(weights[inside].sum() / weights.sum())
    if kept < _SUBJECT.inside_fraction:
        return Subject(
            reason="the scene is a shell, closed on most sides with nothing inside: it was framed from outside"
        )
    gauges = torch.cat([hull.gauge(part.cpu()) for part in means.split(1 << 16)]).to(means.device)
    reason = "the scene is closed on most sides, like a room: what is inside was framed, from inside"
    return Subject(gauges < _SUBJECT.inside_gauge, reason, 1 - kept)


class _Hull:
    """The convex hull of a surface: its reach in many directions, stretched to be as wide as deep."""

    def __init__(self, points: Tensor, areas: Tensor):
        self.areas, self.middle = areas, (areas[:, None] * points).sum(0) / areas.sum()
        offsets = points - self.middle
        spread, axes = torch.linalg.eigh((areas[:, None] * offsets).T @ offsets / areas.sum())
        self.stretch = axes / spread.clamp_min(1e-9 * float(spread[-1])).sqrt()
        self.bins = _directions(_SUBJECT.hull_directions).to(points)
        whitened = self.whitened(points)
        far, order = whitened.norm(dim=1).sort()
        sums = areas[order].cumsum(0)
        usual = far[torch.searchsorted(sums, _SUBJECT.support_quantile * sums[-1:]).clamp_max(len(points) - 1)]
        kept = whitened[~(whitened.norm(dim=1) > _SUBJECT.stray_ratio * usual)]
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
