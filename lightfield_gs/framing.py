"""A rig for a scene that comes without one."""

from __future__ import annotations

import math

import numpy as np

from lightfield_gs.errors import InputError
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.panel import Panel
from lightfield_gs.rig import Rig

_FILL = 0.92  # share of the panel that the content fills
_VISIBLE_OPACITY = 0.1  # fainter Gaussians do not count as content, where there are others
_TAIL = 0.001  # share of the opacity that may lie outside on each side: stray Gaussians of captures ...
_WIDE_TAIL, _FENCE = 0.01, 0.15  # ... and up to this share what is further out than 15 % of the extent of the rest
_DEPTH_TAIL = 0.05
_NEAR = 0.01  # near plane of the rasterizer, scene units
_FIELD_OF_VIEW_DEG = (20.0, 50.0)  # what the panel subtends at its viewing distance, kept within these
_UNKNOWN_FIELD_OF_VIEW_DEG = 30.0


def frame(gaussians: Gaussians, panel: Panel, world_to_camera: np.ndarray | None = None) -> Rig:
    """A rig that shows the whole scene on the panel.

    Content is what the visible Gaussians cover, but for the outermost 0.1 % of their opacity on each side, and for up
    to 1 % where that lies far out. It is centred and fills 92 % of the panel's height, or of the
    width where that is met first. The zero plane is at the harmonic mean of near and far, the depths beyond which 5 %
    of the opacity lies.
    Without a camera, one looks along the file's +z axis with +y down, from so far in front of the content that its
    height takes the angle that the panel subtends for its viewer (kept within 20..50 degrees; 30 when not known).
    Raises InputError on a batch, on no Gaussians, or when none lies in front of the camera.
    """
    if gaussians.is_batched:
        raise InputError(f"framing takes one set of Gaussians, got a batch of {gaussians.means.shape[0]}; frame one")
    if gaussians.count == 0:
        raise InputError("there are no Gaussians to frame")
    means, sizes, weights = _content(gaussians)
    if world_to_camera is None:
        world_to_camera = _camera_in_front(means, sizes, weights, panel)
    rig = Rig(world_to_camera, (1.0, 1.0), (0.0, 0.0), 1.0)  # checks the matrix
    points = means @ rig.world_to_camera[:3, :3].T + rig.world_to_camera[:3, 3]
    ahead = points[:, 2] > _NEAR
    if not ahead.any():
        raise InputError("no Gaussian lies in front of the camera; give another rig")
    points, sizes, weights = points[ahead], sizes[ahead], weights[ahead]
    near, far = (_percentile(points[:, 2], weights, share) for share in (_DEPTH_TAIL, 1 - _DEPTH_TAIL))
    low, high = _bounds(points[:, :2] / points[:, 2:], sizes / points[:, 2], weights)
    extent = np.maximum(high - low, 1e-9)
    focal = _FILL * min(panel.height_px / extent[1], panel.width_px / extent[0])
    centre = np.array([panel.width_px, panel.height_px]) / 2 - focal * (low + high) / 2
    return Rig(rig.world_to_camera, (focal, focal), tuple(centre), 2 / (1 / near + 1 / far))


def _content(gaussians: Gaussians) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres [M, 3], sizes [M] (the middle standard deviation) and opacities [M] of the visible Gaussians."""
    opacities = gaussians.opacities.detach().cpu().double().numpy()
    visible = opacities >= _VISIBLE_OPACITY
    if not visible.any():
        visible[:] = True
    means = gaussians.means.detach().cpu().double().numpy()[visible]
    sizes = np.sort(gaussians.scales.detach().cpu().double().numpy()[visible], 1)[:, 1]
    return means, sizes, opacities[visible]


def _camera_in_front(means: np.ndarray, sizes: np.ndarray, weights: np.ndarray, panel: Panel) -> np.ndarray:
    low, high = _bounds(means, sizes, weights)
    extent = high - low
    height = max(extent[1], extent[0] * panel.height_px / panel.width_px, 1e-6)
    distance = height / _FILL / 2 / math.tan(_field_of_view_rad(panel) / 2)
    matrix = np.eye(4)
    # The front of the content, not its middle, must fit; and stay clear of the near plane.
    matrix[:3, 3] = -(low + high) / 2 + [0, 0, extent[2] / 2 + max(distance, 2 * _NEAR)]
    return matrix


def _field_of_view_rad(panel: Panel) -> float:
    if panel.pixel_pitch_mm is None or panel.viewing_distance_mm is None:
        return math.radians(_UNKNOWN_FIELD_OF_VIEW_DEG)
    angle = 2 * math.atan(panel.height_px * panel.pixel_pitch_mm / 2 / panel.viewing_distance_mm)
    return min(max(angle, math.radians(_FIELD_OF_VIEW_DEG[0])), math.radians(_FIELD_OF_VIEW_DEG[1]))


def _bounds(points: np.ndarray, sizes: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Robust bounds (low, high) of balls with these centres [M, D] and radii [M]."""
    bounds = []
    for axis in range(points.shape[1]):
        first, last = points[:, axis] - sizes, points[:, axis] + sizes
        low, high = _percentile(first, weights, _WIDE_TAIL), _percentile(last, weights, 1 - _WIDE_TAIL)
        fence = _FENCE * (high - low)
        bounds.append((max(low - fence, _percentile(first, weights, _TAIL)),
                       min(high + fence, _percentile(last, weights, 1 - _TAIL))))
    low, high = np.array(bounds).T
    return low, high


def _percentile(values: np.ndarray, weights: np.ndarray, share: float) -> float:
    """The value below which `share` of the weight lies."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    index = np.searchsorted(cumulative, share * cumulative[-1])
    return float(values[order[min(index, len(order) - 1)]])
