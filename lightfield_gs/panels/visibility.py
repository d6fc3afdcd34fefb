"""Depths of what a camera sees: where the subject of a picture stands."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, reduced
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.gaussians import Gaussians, of_tensors

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


def share(content: Gaussians, rest: Gaussians, panel: Panel, rig: Rig) -> float:
    """How much of the content, as it would be seen alone, the cameras see past the rest of the scene, 0..1: the least
    of the outermost two and the one in the middle."""
    both = of_tensors(torch.cat(fields) for fields in zip(content.fields().values(), rest.fields().values()))
    white = torch.zeros(both.count, 1, 3).to(both.means)
    white[: content.count], white[content.count :] = 0.5 / SH_CONSTANT, -0.5 / SH_CONSTANT
    small_panel, small_rig = reduced(panel, rig, _SHARE_SIZE_PX)
    cameras = small_rig.cameras_at(small_panel, [panel.views / 2, 0, panel.views])
    with torch.no_grad():
        alone = render(plain(content), cameras.select([0]), alpha=True)[1].sum((1, 2))
        seen = render(replace(both, sh=white), cameras, background=(0, 0, 0))[..., 0].sum((1, 2))
    return float((seen / alone.clamp_min(1e-9)).min())


def _disparities(gaussians: Gaussians, panel: Panel, rig: Rig) -> tuple[Tensor, Tensor] | None:
    """1 / depth [M] of the surfaces in a small picture, and weights [M], more in its middle."""
    small_panel, small_rig = reduced(panel, rig, _SIZE_PX)
    cameras = small_rig.cameras_at(small_panel, [panel.views / 2])
    with torch.no_grad():
        _, alpha, depth = (image[0] for image in render(plain(gaussians), cameras, alpha=True, depth=True))
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


def plain(gaussians: Gaussians) -> Gaussians:
    """The Gaussians without what depends on the direction: only the shape matters here."""
    return replace(gaussians, sh=gaussians.sh[..., :1, :])
