"""Rendered measurements of a rig: depths of the subject and of points, visible fractions, background past the scene."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.checks import expect, is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.panels.content import select
from lightfield_gs.panels.panel import Panel
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

if TYPE_CHECKING:
    from lightfield_gs.panels.rig import Rig

_SIZE_PX = 256  # width of the pictures, so large that thin things do not blend with their background
_COLOURS_SIZE_PX = 512  # width of the picture of colours, in which thin things are not fainter than in the panel's
_FRACTION_SIZE_PX = 128  # width of the pictures that measure a visible fraction


@dataclass(frozen=True)
class VisibilityConstants:
    """Thresholds of the surfaces that a camera sees.

    All are chosen by hand and not tuned on a data set; tests/panels has the scenes that they must tell apart.
    """

    opaque: float = 0.5  # alpha from which on a pixel shows a surface
    depth_tail: float = 0.01  # fraction of the surfaces left out at either end of the depths

    # The subject in the middle of the picture
    least_surface: float = 0.01  # least fraction of the picture with surfaces
    middle: float = 0.2  # standard deviation of the weight of the middle, in shorter sides of the picture
    front_fraction: float = 0.1  # fraction of the weight that is nearer than the front of the subject
    subject_depth: float = 1.5  # depth of the back of a subject by the depth of its front
    deep: float = 2.5  # far depth by the near one up to which the picture shows one object and no more
    near_zero: float = 1.3  # largest ratio, either way, of a depth near the zero plane to the zero depth
    in_gap: float = 0.06  # largest fraction of the surfaces in a gap: near and far blend at edges

    # The depth at a point
    patch: float = 0.01  # side of the square around the point, in shorter sides of the panel
    least_patch_px: float = 2.0  # side of the square at least, pixels of the panel
    patch_samples: int = 16  # samples of the square, each way
    # least fraction of the square that a surface fills: thin things count before surfaces behind them
    surface_fraction: float = 0.25

    # Views past the scene
    holes: float = 0.01  # largest fraction of the centre view that is background where a scene fills it
    much_background: float = 0.02  # fraction of an outermost view, as background, that nobody overlooks


_CONSTANTS = VisibilityConstants()


def subject_depth(gaussians: Gaussians, panel: Panel, rig: Rig, before_wall: bool = False) -> float | None:
    """Return the depth of the nearest subject in the middle of the centre camera's picture, scene units.

    Args:
        gaussians: One set.
        panel: The panel.
        rig: A rig with the centre camera.
        before_wall: Whether a subject of a shallow scene is its nearer half, as of a photo that ends at a wall.

    Returns:
        View-space z; None where the camera sees nothing.
    """
    surfaces = _disparities(gaussians, panel, rig)
    return None if surfaces is None else _subject_front(*surfaces, before_wall)


def depth_beside_a_gap(gaussians: Gaussians, panel: Panel, rig: Rig) -> float | None:
    """Return `subject_depth` if the visible scene is deep and empty near the zero plane, else None."""
    surfaces = _disparities(gaussians, panel, rig)
    if surfaces is None:
        return None
    disparities, _ = surfaces
    far, near = torch.quantile(
        disparities, torch.tensor([_CONSTANTS.depth_tail, 1 - _CONSTANTS.depth_tail]).to(disparities)
    ).tolist()
    around = (disparities * rig.zero_depth).log().abs() <= math.log(_CONSTANTS.near_zero)
    if near < _CONSTANTS.deep * far or float(around.double().mean()) > _CONSTANTS.in_gap:
        return None
    return _subject_front(*surfaces)


def _subject_front(disparities: Tensor, weights: Tensor, before_wall: bool = False) -> float:
    """Return the median depth of the surfaces that are hardly farther than the nearest."""
    front = _nearest(disparities, weights, _CONSTANTS.front_fraction)
    back = front / _CONSTANTS.subject_depth
    if before_wall:
        back = max(back, (front + float(torch.quantile(disparities, _CONSTANTS.depth_tail))) / 2)
    subject = disparities >= back
    return 1 / _nearest(disparities[subject], weights[subject], 0.5)


def _nearest(disparities: Tensor, weights: Tensor, fraction: float) -> float:
    """Return the disparity above which this fraction of the weights lies."""
    ordered, order = disparities.sort(descending=True)
    sums = weights[order].double().cumsum(0)
    return float(ordered[torch.searchsorted(sums, fraction * sums[-1:]).clamp_max(len(ordered) - 1)])


def visible_fraction(content: Gaussians, rest: Gaussians, panel: Panel, rig: Rig) -> float:
    """Return the fraction 0..1 of the content that the cameras see past the rest of the scene.

    It is the least of the outermost two cameras and the centre one, against the content alone.
    """
    both = from_tensors(torch.cat(fields) for fields in zip(content.fields().values(), rest.fields().values()))
    white = torch.zeros(both.count, 1, 3).to(both.means)
    white[: content.count], white[content.count :] = 0.5 / SH_CONSTANT, -0.5 / SH_CONSTANT
    small_panel, small_rig = rig.reduced(panel, _FRACTION_SIZE_PX)
    cameras = small_rig.cameras_at(small_panel, [panel.views / 2, 0, panel.views])
    with torch.no_grad():
        alone = cast(Tensor, render(degree_zero(content), cameras.select([0]), alpha=True).alpha).sum((1, 2))
        surfaces = render(replace(both, sh=white), cameras, background=(0, 0, 0)).image[..., 0].sum((1, 2))
    return float((surfaces / alone.clamp_min(1e-9)).min())


def _disparities(gaussians: Gaussians, panel: Panel, rig: Rig) -> tuple[Tensor, Tensor] | None:
    """Return 1 / depth [M] of the surfaces in a small picture, and weights [M], larger in its middle."""
    small_panel, small_rig = rig.reduced(panel, _SIZE_PX)
    cameras = small_rig.cameras_at(small_panel, [panel.views / 2])
    with torch.no_grad():
        images = render(degree_zero(gaussians), cameras, alpha=True, depth=True)
    alpha, depth = cast(Tensor, images.alpha)[0], cast(Tensor, images.depth)[0]
    surface = (alpha >= _CONSTANTS.opaque) & (depth > 0)
    if float(surface.double().mean()) < _CONSTANTS.least_surface:
        return None
    rows, columns = (torch.arange(size, device=depth.device) + 0.5 - size / 2 for size in depth.shape)
    squares = rows[:, None] ** 2 + columns**2
    weights = torch.exp(-squares / 2 / (_CONSTANTS.middle * min(depth.shape)) ** 2).to(depth)
    return 1 / depth[surface], weights[surface]


def check_single(gaussians: Gaussians) -> None:
    """Raise InputError unless `gaussians` is one set of Gaussians."""
    expect("gaussians", gaussians, Gaussians)
    gaussians.validate_layout()
    if gaussians.is_batched:
        raise InputError(f"gaussians: expected one set, got a batch of {gaussians.means.shape[0]}; give one of them")


def degree_zero(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians without their graph, with the first harmonic only: depths need no colour."""
    return replace(gaussians.detach(), sh=gaussians.sh.detach()[..., :1, :])


def depth_at(gaussians: Gaussians, panel: Panel, rig: Rig, point: tuple[float, float]) -> float:
    """Return the view-space z, scene units, of the nearest opaque surface that the centre camera sees at a point.

    The Gaussians up to this depth make a quarter of a small square around the point opaque (alpha 0.5 or more). The
    square's side is 1 % of the panel's shorter side. Background and haze would move a mean depth, but do not move this
    one.

    Args:
        gaussians: One set, in the rig's coordinates.
        panel: The panel.
        rig: Its rig.
        point: (x, y) of the picture, 0..1 each, of the panel's width from the left and of its height from the top.

    Raises:
        InputError: No opaque surface is at the point.
    """
    check_single(gaussians)
    if not is_row(point, 2):
        raise InputError(f"focus: expected x,y of a point of the picture, 0..1 each, got {shown(point)}")
    x, y = (real_number(f"focus: {axis}", value, 0, 1) for axis, value in zip("xy", point))
    with torch.no_grad():
        return _surface(degree_zero(gaussians), _patch(panel, rig, x, y), f"{x:g},{y:g}")


def _surface(gaussians: Gaussians, camera: Cameras, name: str) -> float:
    """Return the depth of the nearest opaque surface before the camera; name: of the point, for the error."""
    images = render(gaussians, camera, alpha=True, radii=True)
    alpha, radii = cast(Tensor, images.alpha), cast(Tensor, images.radii)
    if _opaque_fraction(alpha) < _CONSTANTS.surface_fraction:
        raise InputError(
            f"focus: nothing opaque is at {name} of the picture (alpha {float(alpha.mean()):.2g}, expected "
            f"{_CONSTANTS.opaque:g} or more); give another point (x,y: of the width from the left, of the height from "
            "the top), or a depth"
        )
    visible = select(gaussians, radii[0] > 0)
    pose = camera.world_to_camera[0].to(visible.means)
    depths, order = (visible.means @ pose[2, :3] + pose[2, 3]).sort()
    few, enough = 0, len(order)  # so many of the nearest are too few, and enough, to make a surface
    while enough - few > 1:
        middle = (few + enough) // 2
        alpha = cast(Tensor, render(select(visible, order[:middle]), camera, alpha=True).alpha)
        few, enough = (few, middle) if _opaque_fraction(alpha) >= _CONSTANTS.surface_fraction else (middle, enough)
    return float(depths[enough - 1])


def _opaque_fraction(alpha: torch.Tensor) -> float:
    return float((alpha >= _CONSTANTS.opaque).double().mean())


def _patch(panel: Panel, rig: Rig, x: float, y: float) -> Cameras:
    """Return the centre camera, cropped to a small square around the point."""
    centre = rig.cameras_at(panel, [panel.views / 2])
    side = max(_CONSTANTS.least_patch_px, _CONSTANTS.patch * min(panel.width_px, panel.height_px))
    scale = _CONSTANTS.patch_samples / side
    corner = torch.tensor([x * panel.width_px - side / 2, y * panel.height_px - side / 2], dtype=torch.float64)
    principal_point = torch.tensor([rig.principal_point_px], dtype=torch.float64)
    return Cameras(
        centre.world_to_camera,
        centre.focal_px * scale,
        (principal_point - corner) * scale,
        _CONSTANTS.patch_samples,
        _CONSTANTS.patch_samples,
        jacobian_limits=centre.jacobian_limits,
    )


@dataclass(frozen=True)
class ViewCoverage:
    """Depths in the centre view, and background in the outermost views.

    Attributes:
        near: View-space z, scene units, that 1 % of the surfaces in the centre view are nearer than.
        far: View-space z; 1 % of the surfaces are farther.
        background: For views 0 and N-1, the fraction 0..1 of the continuing scene that shows background.
    """

    near: float
    far: float
    background: tuple[float, float]


def view_coverage(gaussians: Gaussians, panel: Panel, rig: Rig) -> ViewCoverage:
    """Measure depths and background of a rig's views, in pictures 256 pixels wide.

    Take two neighbouring pixels of a row that show surfaces in the centre view and stand apart in an outermost view.
    The scene continues between them, as it does beyond a pixel at the picture's edge. Transparency there is a part of
    the scene that was never captured, for example in a photo.

    Args:
        gaussians: One set, in the rig's coordinates.
        panel: The panel.
        rig: Its rig.

    Raises:
        InputError: The centre camera sees nothing.
    """
    check_single(gaussians)
    small_rig = rig.reduced(panel, _SIZE_PX)[1]
    outermost = [0.5, panel.views - 0.5]
    alpha, depth = _pictures(gaussians, panel, rig, [panel.views / 2, *outermost])
    opaque = min(_CONSTANTS.opaque, float(alpha[0].max()) / 2)
    surface = (alpha[0] >= opaque) & (depth > 0)
    if not surface.any():
        raise InputError(
            "the centre camera sees nothing of the scene; look at the pose of the rig, the zoom and the pan"
        )
    near, far = _depth_ends(depth[surface])
    fractions = []
    for x, surfaces in zip(outermost, alpha[1:]):
        factor = small_rig.focal_px[0] * float(small_rig.offset(x, panel))
        moves = factor * (1 / rig.zero_depth - 1 / np.where(surface, depth, 1))
        goes_on = _between(surface, moves)
        fractions.append(float((goes_on & (surfaces < opaque)).sum() / max(1, goes_on.sum())))
    return ViewCoverage(near, far, (fractions[0], fractions[1]))


def visible_depths(gaussians: Gaussians, panel: Panel, rig: Rig) -> tuple[float, float] | None:
    """Return near and far of `view_coverage`, from one picture; None where the centre camera sees nothing."""
    alpha, depth = _pictures(gaussians, panel, rig, [panel.views / 2])
    surface = (alpha[0] >= min(_CONSTANTS.opaque, float(alpha[0].max()) / 2)) & (depth > 0)
    return _depth_ends(depth[surface]) if surface.any() else None


def _depth_ends(depths: np.ndarray) -> tuple[float, float]:
    """Return the depths that 1 % of these depths [M] are nearer and farther than."""
    near, far = np.quantile(depths, [_CONSTANTS.depth_tail, 1 - _CONSTANTS.depth_tail])
    return float(near), float(far)


def centre_picture(gaussians: Gaussians, panel: Panel, rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels of a small picture of the centre camera show the scene, bool [H, W], and depths [H, W]."""
    alpha, depth = _pictures(gaussians, panel, rig, [panel.views / 2])
    return (alpha[0] >= _CONSTANTS.opaque) & (depth > 0), depth


def centre_colours(gaussians: Gaussians, panel: Panel, rig: Rig) -> np.ndarray:
    """Return a small picture of the centre camera: red, green, blue and alpha, straight, 0..1, [H, W, 4]."""
    small_panel, small_rig = rig.reduced(panel, _COLOURS_SIZE_PX)
    cameras = small_rig.cameras_at(small_panel, [panel.views / 2])
    with torch.no_grad():
        images = render(gaussians.detach(), cameras, background=(0, 0, 0), alpha=True)
    alpha = cast(Tensor, images.alpha)[0][..., None]
    colours = (images.image[0] / alpha.clamp_min(1e-6)).clamp(0, 1)
    return torch.cat([colours, alpha], -1).float().cpu().numpy()


def background_fraction(gaussians: Gaussians, panel: Panel, rig: Rig) -> float | None:
    """Return the fraction 0..1 of background in an outermost view, the larger of the two.

    One picture of 256 pixels width is enough to return None, three are drawn otherwise.

    Args:
        gaussians: One set, in the rig's coordinates.
        panel: The panel.
        rig: Its rig.

    Returns:
        None where the scene does not fill the centre view: background beside a single object may well be air.
    """
    check_single(gaussians)
    centre, _ = _pictures(gaussians, panel, rig, [panel.views / 2])
    if (centre < _CONSTANTS.opaque).mean() > _CONSTANTS.holes:
        return None
    outermost, _ = _pictures(gaussians, panel, rig, [0.5, panel.views - 0.5])
    return float((outermost < _CONSTANTS.opaque).mean((1, 2)).max())


def background_warning(fraction: float) -> str | None:
    """Return the remedy for that much background in an outermost view; None where it is too little to see."""
    if fraction <= _CONSTANTS.much_background:
        return None
    return (
        f"the outermost views look past what the scene knows: {fraction:.1%} of the scene's place is background there; "
        "give a smaller cone_deg= or depth_amount=, or a larger zoom="
    )


def _pictures(gaussians: Gaussians, panel: Panel, rig: Rig, places: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha [n, H, W] of small pictures at these view coordinates, and depth [H, W] of the first one."""
    gaussians = degree_zero(gaussians)
    small_panel, small_rig = rig.reduced(panel, _SIZE_PX)
    cameras = small_rig.cameras_at(small_panel, places)
    with torch.no_grad():
        images = render(gaussians, cameras, alpha=True, depth=True)
    alpha, depth = cast(Tensor, images.alpha), cast(Tensor, images.depth)[0]
    return alpha.double().cpu().numpy(), depth.double().cpu().numpy()


def _between(surface: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Return the pixels, bool [H, W], between two neighbours of a row that both show surfaces, after both have moved.

    Args:
        surface: bool [H, W].
        moves: Pixels that each moves to the right, [H, W].
    """
    height, width = surface.shape
    places = np.clip(np.arange(width) + 0.5 + moves, 0, width)
    # Beyond the edges of the picture the scene continues without end
    places = np.pad(places, ((0, 0), (1, 1)), constant_values=((0, 0), (0, width)))
    there = np.pad(surface, ((0, 0), (1, 1)), mode="edge")
    rows, columns = np.nonzero(there[:, :-1] & there[:, 1:])
    ends = np.sort(np.stack([places[rows, columns], places[rows, columns + 1]]), 0)
    first, beyond = np.ceil(ends[0] - 0.5).astype(int), np.floor(ends[1] - 0.5).astype(int) + 1
    changes = np.zeros((height, width + 1), int)
    np.add.at(changes, (rows, first), 1)
    np.add.at(changes, (rows, np.maximum(first, beyond)), -1)
    return changes.cumsum(1)[:, :-1] > 0
