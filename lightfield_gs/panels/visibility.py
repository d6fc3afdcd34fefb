"""What the cameras of a rig see: depths of the subject and of points, and background past the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.panels.extent import select
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, reduced
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

_SIZE_PX = 256  # width of the picture that is looked at, so large that thin things do not blend with what is behind
_SHARE_SIZE_PX = 128  # width of the picture where it only matters how much of the content shows
_OPAQUE = 0.5  # alpha from which on a pixel shows a surface
_LEAST_SEEN = 0.01  # share of the picture that must show surfaces
_MIDDLE = 0.2  # standard deviation of the weight of the middle, in shorter sides of the picture
_NEAREST_SHARE = 0.1  # share of what is seen in the middle that is nearer than the front of the subject
_SUBJECT = 1.5  # how far a subject reaches, in depths of its front
_DEPTH_TAIL = 0.01  # share of what is seen that is left out at either end of the depths
_DEEP = 2.5  # far depth in near ones, up to which the picture shows one object and no more
_NEAR_ZERO = 1.3  # a depth is near the zero plane if their ratio is at most this, either way
_IN_GAP = 0.06  # share of what is seen that may lie in a gap: at edges near and far blend


def subject_depth(gaussians: Gaussians, panel: Panel, rig: Rig) -> float | None:
    """Depth of the nearest of what the centre camera sees in the middle of its picture; None where it sees nothing."""
    seen = _disparities(gaussians, panel, rig)
    return None if seen is None else _nearest_in_the_middle(*seen)


def depth_beside_a_gap(gaussians: Gaussians, panel: Panel, rig: Rig) -> float | None:
    """`subject_depth` where what is seen is deep and nothing of it is near the zero plane; None elsewhere."""
    seen = _disparities(gaussians, panel, rig)
    if seen is None:
        return None
    disparities, _ = seen
    far, near = torch.quantile(disparities, torch.tensor([_DEPTH_TAIL, 1 - _DEPTH_TAIL]).to(disparities)).tolist()
    around = (disparities * rig.zero_depth).log().abs() <= math.log(_NEAR_ZERO)
    if near < _DEEP * far or float(around.double().mean()) > _IN_GAP:
        return None
    return _nearest_in_the_middle(*seen)


def _nearest_in_the_middle(disparities: Tensor, weights: Tensor) -> float:
    """Depth of the middle one among those that are hardly farther than the nearest."""
    front = _nearest(disparities, weights, _NEAREST_SHARE)
    subject = disparities >= front / _SUBJECT
    return 1 / _nearest(disparities[subject], weights[subject], 0.5)


def _nearest(disparities: Tensor, weights: Tensor, share: float) -> float:
    """The disparity that this share of the weights is nearer than."""
    ordered, order = disparities.sort(descending=True)
    sums = weights[order].double().cumsum(0)
    return float(ordered[torch.searchsorted(sums, share * sums[-1:]).clamp_max(len(ordered) - 1)])


def visible_fraction(content: Gaussians, rest: Gaussians, panel: Panel, rig: Rig) -> float:
    """How much of the content, as it would be seen alone, the cameras see past the rest of the scene, 0..1: the least
    of the outermost two and the one in the middle."""
    both = from_tensors(torch.cat(fields) for fields in zip(content.fields().values(), rest.fields().values()))
    white = torch.zeros(both.count, 1, 3).to(both.means)
    white[: content.count], white[content.count :] = 0.5 / SH_CONSTANT, -0.5 / SH_CONSTANT
    small_panel, small_rig = reduced(panel, rig, _SHARE_SIZE_PX)
    cameras = small_rig.cameras_at(small_panel, [panel.views / 2, 0, panel.views])
    with torch.no_grad():
        alone = cast(Tensor, render(degree_zero(content), cameras.select([0]), alpha=True).alpha).sum((1, 2))
        seen = render(replace(both, sh=white), cameras, background=(0, 0, 0)).image[..., 0].sum((1, 2))
    return float((seen / alone.clamp_min(1e-9)).min())


def _disparities(gaussians: Gaussians, panel: Panel, rig: Rig) -> tuple[Tensor, Tensor] | None:
    """1 / depth [M] of the surfaces in a small picture, and weights [M], more in its middle."""
    small_panel, small_rig = reduced(panel, rig, _SIZE_PX)
    cameras = small_rig.cameras_at(small_panel, [panel.views / 2])
    with torch.no_grad():
        images = render(degree_zero(gaussians), cameras, alpha=True, depth=True)
    alpha, depth = cast(Tensor, images.alpha)[0], cast(Tensor, images.depth)[0]
    surface = (alpha >= _OPAQUE) & (depth > 0)
    if float(surface.double().mean()) < _LEAST_SEEN:
        return None
    rows, columns = (torch.arange(size, device=depth.device) + 0.5 - size / 2 for size in depth.shape)
    squares = rows[:, None] ** 2 + columns**2
    weights = torch.exp(-squares / 2 / (_MIDDLE * min(depth.shape)) ** 2).to(depth)
    return 1 / depth[surface], weights[surface]


def check_single(gaussians: Gaussians) -> None:
    """Raises InputError on what is no set of Gaussians, or a batch of them."""
    expect("gaussians", gaussians, Gaussians)
    gaussians.validate_layout()
    if gaussians.is_batched:
        raise InputError(f"gaussians: expected one set, got a batch of {gaussians.means.shape[0]}; give one of them")


def degree_zero(gaussians: Gaussians) -> Gaussians:
    """The Gaussians without what depends on the direction: only the shape matters here."""
    return replace(gaussians, sh=gaussians.sh[..., :1, :])


_PATCH = 0.01  # side of the square around the point that is looked at, in shorter sides of the panel
_LEAST_PATCH_PX = 2.0  # of the panel: a smaller square would see less than a pixel does
_SAMPLES = 16  # of the square, each way
_OPAQUE = 0.5  # alpha from which on a sample shows a surface
_SURFACE_SHARE = 0.25  # share of the square that a surface fills at least: thin things count before what is behind


def depth_at(gaussians: Gaussians, panel: Panel, rig: Rig, point: tuple[float, float]) -> float:
    """View-space z, in scene units, of the nearest opaque surface that the centre camera sees at a point.

    point: (x, y) of its picture, 0..1 each, of the panel's width from the left and of its height from the top.
    The surface is the nearest depth by which a quarter of a small square around the point (1 % of the panel's shorter
    side) is opaque, alpha 0.5 or more, if only the Gaussians up to it are drawn: neither what is behind nor haze before
    it moves it, as they would a mean depth. Raises InputError, also where there is no such surface.
    """
    check_single(gaussians)
    if not is_row(point, 2):
        raise InputError(f"focus: expected x,y of a point of the picture, 0..1 each, got {shown(point)}")
    x, y = (real_number(f"focus: {axis}", value, 0, 1) for axis, value in zip("xy", point))
    with torch.no_grad():
        return _surface(degree_zero(gaussians.detach()), _patch(panel, rig, x, y), f"{x:g},{y:g}")


def _surface(gaussians: Gaussians, camera: Cameras, name: str) -> float:
    """Depth of the nearest opaque surface before this camera; name: of the point, for the complaint."""
    images = render(gaussians, camera, alpha=True, radii=True)
    alpha, radii = cast(Tensor, images.alpha), cast(Tensor, images.radii)
    if _opaque_share(alpha) < _SURFACE_SHARE:
        raise InputError(
            f"focus: nothing opaque is at {name} of the picture (alpha {float(alpha.mean()):.2g}, expected {_OPAQUE:g} "
            "or more); give another point (x,y: of the width from the left, of the height from the top), or a depth"
        )
    drawn = select(gaussians, radii[0] > 0)
    pose = camera.world_to_camera[0].to(drawn.means)
    depths, order = (drawn.means @ pose[2, :3] + pose[2, 3]).sort()
    few, enough = 0, len(order)  # so many of the nearest are too few, and enough, to make a surface
    while enough - few > 1:
        middle = (few + enough) // 2
        alpha = cast(Tensor, render(select(drawn, order[:middle]), camera, alpha=True).alpha)
        few, enough = (few, middle) if _opaque_share(alpha) >= _SURFACE_SHARE else (middle, enough)
    return float(depths[enough - 1])


def _opaque_share(alpha: torch.Tensor) -> float:
    return float((alpha >= _OPAQUE).double().mean())


def _patch(panel: Panel, rig: Rig, x: float, y: float) -> Cameras:
    """The centre camera, of whose picture only a small square around the point is left."""
    centre = rig.cameras_at(panel, [panel.views / 2])
    side = max(_LEAST_PATCH_PX, _PATCH * min(panel.width_px, panel.height_px))
    scale = _SAMPLES / side
    corner = torch.tensor([x * panel.width_px - side / 2, y * panel.height_px - side / 2], dtype=torch.float64)
    principal_point = torch.tensor([rig.principal_point_px], dtype=torch.float64)
    return Cameras(
        centre.world_to_camera,
        centre.focal_px * scale,
        (principal_point - corner) * scale,
        _SAMPLES,
        _SAMPLES,
        jacobian_limits=centre.jacobian_limits,
    )


_SIZE_PX = 256  # width of the pictures that are compared
_OPAQUE = 0.5  # alpha from which on a pixel shows a surface; half the largest where none is so opaque
_DEPTH_TAIL = 0.01  # share of the pixels that is left out at either end of the depths
_HOLES = 0.01  # share of the centre view that may be background where a scene fills it
_MUCH_UNSEEN = 0.02  # share of an outermost view that nobody overlooks


@dataclass(frozen=True)
class ViewCoverage:
    """near, far: view-space z, scene units, that 1 % of the surfaces in the centre view are nearer and farther than.
    unseen: for views 0 and N-1, how much of where the scene goes on they show as background, 0..1.
    """

    near: float
    far: float
    unseen: tuple[float, float]


def view_coverage(gaussians: Gaussians, panel: Panel, rig: Rig) -> ViewCoverage:
    """What is seen by the cameras of the rig, of pictures 256 pixels wide. gaussians: in the rig's coordinates.

    Neighbouring pixels of a row whose surfaces the centre view sees, and which stand apart in an outermost view, have
    surface between them: the scene goes on there, as it does beyond the edge of the picture behind a pixel at the edge.
    What is transparent there is what was never seen, of a photo for example.
    Raises InputError where nothing is seen.
    """
    check_single(gaussians)
    small_rig = reduced(panel, rig, _SIZE_PX)[1]
    outermost = [0.5, panel.views - 0.5]
    alpha, depth = _pictures(gaussians, panel, rig, [panel.views / 2, *outermost])
    opaque = min(_OPAQUE, float(alpha[0].max()) / 2)
    surface = (alpha[0] >= opaque) & (depth > 0)
    if not surface.any():
        raise InputError(
            "the centre camera sees nothing of the scene; look at the pose of the rig, the zoom and the pan"
        )
    near, far = np.quantile(depth[surface], [_DEPTH_TAIL, 1 - _DEPTH_TAIL])
    shares = []
    for x, seen in zip(outermost, alpha[1:]):
        factor = small_rig.focal_px[0] * float(small_rig.offset(x, panel))
        moves = factor * (1 / rig.zero_depth - 1 / np.where(surface, depth, 1))
        goes_on = _between(surface, moves)
        shares.append(float((goes_on & (seen < opaque)).sum() / max(1, goes_on.sum())))
    return ViewCoverage(float(near), float(far), (shares[0], shares[1]))


def background_fraction(gaussians: Gaussians, panel: Panel, rig: Rig) -> float | None:
    """How much of an outermost view is background, 0..1, the larger share of the two, where the scene fills the centre
    view. None where it does not: what is background in a view of an object alone may well be air.

    One picture 256 pixels wide tells the latter, three the former. gaussians: in the rig's coordinates.
    """
    check_single(gaussians)
    centre, _ = _pictures(gaussians, panel, rig, [panel.views / 2])
    if (centre < _OPAQUE).mean() > _HOLES:
        return None
    outermost, _ = _pictures(gaussians, panel, rig, [0.5, panel.views - 0.5])
    return float((outermost < _OPAQUE).mean((1, 2)).max())


def background_warning(share: float) -> str | None:
    """What to change where that much of an outermost view is background; None where nobody would see it."""
    if share <= _MUCH_UNSEEN:
        return None
    return (
        f"the outermost views look past what the scene knows: {share:.1%} of the scene's place is background there; "
        "give a smaller --cone or --depth-amount, or a larger --zoom"
    )


def _pictures(gaussians: Gaussians, panel: Panel, rig: Rig, places: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Alpha [n, H, W] of small pictures at these view coordinates, and depth [H, W] of the first one."""
    small_panel, small_rig = reduced(panel, rig, _SIZE_PX)
    with torch.no_grad():
        images = render(
            degree_zero(gaussians.detach()), small_rig.cameras_at(small_panel, places), alpha=True, depth=True
        )
    alpha, depth = cast(Tensor, images.alpha), cast(Tensor, images.depth)[0]
    return alpha.double().cpu().numpy(), depth.double().cpu().numpy()


def _between(surface: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Which pixels lie between two neighbours of a row that both show surfaces, bool [H, W], after each has moved.

    surface: bool [H, W]; moves: by how many pixels each goes to the right, [H, W].
    """
    height, width = surface.shape
    places = np.clip(np.arange(width) + 0.5 + moves, 0, width)
    # Beyond the edges of the picture the scene goes on as far as anyone looks
    places = np.pad(places, ((0, 0), (1, 1)), constant_values=((0, 0), (0, width)))
    there = np.pad(surface, ((0, 0), (1, 1)), mode="edge")
    rows, columns = np.nonzero(there[:, :-1] & there[:, 1:])
    ends = np.sort(np.stack([places[rows, columns], places[rows, columns + 1]]), 0)
    first, beyond = np.ceil(ends[0] - 0.5).astype(int), np.floor(ends[1] - 0.5).astype(int) + 1
    changes = np.zeros((height, width + 1), int)
    np.add.at(changes, (rows, first), 1)
    np.add.at(changes, (rows, np.maximum(first, beyond)), -1)
    return changes.cumsum(1)[:, :-1] > 0
