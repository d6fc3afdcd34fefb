"""Depths of what a camera sees: where the subject of a picture stands."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from lightfield_gs.cameras import Cameras
from lightfield_gs.gaussians import SH_CONSTANT, Gaussians
from lightfield_gs.panel import Panel
from lightfield_gs.rendering import render
from lightfield_gs.rig import Rig

_SIZE_PX = 96  # longer side of the picture that is looked at
_OPAQUE = 0.5  # what covers less is not seen as a surface
_LEAST_SEEN = 0.01  # share of the picture that must show surfaces
_MIDDLE = 0.2  # standard deviation of what counts as the middle, in units of the picture's shorter side
_NEAREST_SHARE = 0.25  # of what is seen in the middle: the subject is what of it is nearest
_DEPTH_TAIL = 0.05  # of what is seen, left out at either end
_DEEP = 2.5  # far to near: an object and no more is less deep
_GAP_HALF_WIDTH = 0.15  # of the range of disparities, to either side of the zero plane
_IN_GAP = 0.03  # share of what is seen that is nothing


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
    around = (disparities - 1 / rig.zero_depth).abs() <= _GAP_HALF_WIDTH * (near - far)
    if near < _DEEP * far or float(around.double().mean()) > _IN_GAP:
        return None
    return _nearest_in_the_middle(*seen)


def _nearest_in_the_middle(disparities: Tensor, weights: Tensor) -> float:
    ordered, order = disparities.sort(descending=True)
    sums = weights[order].cumsum(0)
    index = torch.searchsorted(sums, (_NEAREST_SHARE * sums[-1:]).contiguous()).clamp_max(len(ordered) - 1)
    return 1 / float(ordered[index])


def share(content: Gaussians, rest: Gaussians, panel: Panel, rig: Rig) -> float:
    """How much of the content, as it would be seen alone, the centre camera sees past the rest of the scene, 0..1."""
    both = Gaussians(*(torch.cat(fields) for fields in zip(content.fields().values(), rest.fields().values())))
    white = torch.zeros(both.count, 1, 3).to(both.means)
    white[:content.count], white[content.count:] = 0.5 / SH_CONSTANT, -0.5 / SH_CONSTANT
    with torch.no_grad():
        alone = render(_plain(content), _small_camera(panel, rig), alpha=True)[1].sum()
        seen = render(replace(both, sh=white), _small_camera(panel, rig), background=(0, 0, 0))[..., 0].sum()
    return float(seen / alone) if alone > 0 else 0.0


def _disparities(gaussians: Gaussians, panel: Panel, rig: Rig) -> tuple[Tensor, Tensor] | None:
    """1 / depth [M] of the surfaces in a small picture, and weights [M], more in its middle."""
    with torch.no_grad():
        _, alpha, depth = (image[0] for image in render(_plain(gaussians), _small_camera(panel, rig), alpha=True,
                                                        depth=True))
    surface = (alpha >= _OPAQUE) & (depth > 0)
    if float(surface.double().mean()) < _LEAST_SEEN:
        return None
    rows, columns = (torch.arange(size, device=depth.device) + 0.5 - size / 2 for size in depth.shape)
    squares = rows[:, None]**2 + columns**2
    weights = torch.exp(-squares / 2 / (_MIDDLE * min(depth.shape))**2).to(depth)
    return 1 / depth[surface], weights[surface]


def _small_camera(panel: Panel, rig: Rig) -> Cameras:
    """The centre camera at a resolution that shows what is where."""
    scale = min(1.0, _SIZE_PX / max(panel.width_px, panel.height_px))
    width, height = (max(1, round(size * scale)) for size in (panel.width_px, panel.height_px))
    numbers = torch.tensor([[rig.focal_px], [rig.principal_point_px]], dtype=torch.float64) * scale
    return Cameras(torch.from_numpy(rig.world_to_camera)[None], *numbers, width, height)


def _plain(gaussians: Gaussians) -> Gaussians:
    """Without what depends on the direction: only the shape matters here."""
    return replace(gaussians, sh=gaussians.sh[..., :1, :])
