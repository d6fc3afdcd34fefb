"""PSNR of what comes into view beside edges, in views of a fitted scene from beside one of its photographs.

The photograph and the scene's depths there make a photo with depth. Its views from the sides are compared with the
scene's own, in the pixels that the photo's visible surfaces leave open.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.photo.depth_edges import snap_mixed
from lightfield_gs.photo.hidden import Hidden, find_hidden
from lightfield_gs.photo.rgbd import surface_layers
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, from_tensors
from training.data.capture_depth import photograph_camera, photograph_depth

ANGLES_DEG = (10, 15, 20)
_OPEN, _SEEN = 0.5, 0.9  # alpha up to which the photo's surfaces leave a pixel open, and from which the scene shows one
_DEPTHS = (0.05, 0.95)  # quantiles of the depths; the zero plane is in their middle
Fill = Callable[[Tensor, Tensor, Hidden], tuple[Hidden, Tensor]]


class SideViews:
    """A photograph of a capture and the views beside it.

    Args:
        capture: The capture's folder.
        scene: Gaussians that were fitted to it.
        name: Of the photograph.

    Attributes:
        cameras: One to the left and one to the right for each of ANGLES_DEG, in the photograph's axes.
        truths: [C,H,W,3], what the scene looks like there.
    """

    def __init__(self, capture: Path, scene: Path, name: str) -> None:
        photographs, gaussians = read_capture(capture), read_scene(scene).gaussians
        camera = photograph_camera(photographs, name, gaussians)
        image = torch.from_numpy(photographs.image(photographs.names.index(name)).astype(np.float32) / 255)
        self._image = _matched(image, *(part[0] for part in _views(gaussians, camera)))
        self._focal = (float(camera.focal_px[0, 0]), float(camera.focal_px[0, 1]))
        self._centre = (float(camera.principal_point_px[0, 0]), float(camera.principal_point_px[0, 1]))
        self._depth = snap_mixed(photograph_depth(gaussians, camera), self._focal)
        known = self._depth[self._depth.isfinite()]
        near, far = (float(known.quantile(at)) for at in _DEPTHS)
        turns = torch.stack([_turned(sign * deg, 2 / (1 / near + 1 / far)) for deg in ANGLES_DEG for sign in (-1, 1)])
        self.cameras = _moved(camera, turns)
        self.truths, seen = _views(gaussians, _moved(camera, turns @ camera.world_to_camera[0]))
        self._found = find_hidden(self._image, self._depth, self._focal)
        visible = self._parts(self._found, self._image)[:2]
        _, alpha = _views(_joined(visible), self.cameras)
        # Beyond the photo's border there is nothing to fill
        _, filled = _views(_joined(self._parts(self._found, self._image)), self.cameras)
        self._open = (alpha < _OPEN) & (filled > _SEEN) & (seen > _SEEN)

    def _parts(self, found: Hidden, behind: Tensor) -> list[tuple[Tensor, ...]]:
        opacity = torch.full_like(self._depth, 0.99)
        return surface_layers(self._image, self._depth, opacity, found, behind, self._focal, self._centre)

    @torch.no_grad()
    def views(self, fill: Fill) -> Tensor:
        """Return views [C,H,W,3] with a filling."""
        found, behind = fill(self._image, self._depth, self._found)
        return _views(_joined(self._parts(found, behind)), self.cameras)[0]

    def scores(self, views: Tensor) -> dict[int, float]:
        """Return the PSNR of the open pixels, dB, by the angle."""
        errors = (views - self.truths).square().mean(-1)
        pairs = zip(ANGLES_DEG, errors.split(2), self._open.split(2))
        return {deg: float(-10 * error[is_open].mean().log10()) for deg, error, is_open in pairs}


def _matched(image: Tensor, wanted: Tensor, alpha: Tensor) -> Tensor:
    """Return the photograph with the exposure of the scene: the best gain and offset of each channel."""
    there = alpha > _SEEN
    result = image.clone()
    for channel in range(3):
        own = torch.stack([image[..., channel], torch.ones_like(alpha)], -1)
        gain = torch.linalg.lstsq(own[there], wanted[..., channel][there][:, None]).solution
        result[..., channel] = (own @ gain)[..., 0].clamp(0, 1)
    return result


def _joined(parts: list[tuple[Tensor, ...]]) -> Gaussians:
    return from_tensors(torch.cat(fields) for fields in zip(*parts))


@torch.no_grad()
def _views(gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Return colours before black [C,H,W,3] and alpha [C,H,W]."""
    images, alpha, _, _ = render(gaussians, cameras, background=(0.0, 0.0, 0.0), alpha=True)
    return images, alpha.view(images.shape[:3])


def _turned(degrees: float, distance: float) -> Tensor:
    """Return the change [4,4] of a camera that turns about a point so far before it, upright."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn = torch.tensor([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0], [0, 0, 0, 1]])
    there, back = torch.eye(4), torch.eye(4)
    there[2, 3], back[2, 3] = -distance, distance
    return back @ turn @ there


def _moved(camera: Cameras, poses: Tensor) -> Cameras:
    """Return cameras of these poses [C,4,4], otherwise as the given one."""
    count = len(poses)
    return Cameras(
        poses,
        camera.focal_px.expand(count, -1),
        camera.principal_point_px.expand(count, -1),
        camera.width_px,
        camera.height_px,
    )
