"""Which pixels of photographs a panel can show: what is left of a scene for a panel is scored by these alone.

All views of a panel look through one window: what its zero plane shows of the scene. A photograph looks past it as
well, at what no view shows and pruning leaves out. So a pixel counts here if its ray goes through the window, from the
side of the panel's cameras. Of a photograph at one of their places that is what the panel shows, exactly. One that was
taken from above or below them, or nearer, sees through the window also some of what lies outside their views, and what
it misses there counts against the pruned scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.fitting.display import Display
from lightfield_gs.fitting.views import Views
from lightfield_gs.fitting.world import World

PROTOCOL = (
    "of held-out photographs inside the panel's cone, those pixels alone whose rays go through the panel's frame in "
    "its zero plane; the others are as if a mask left them out"
)


@dataclass(frozen=True)
class Frame:
    """The panel's window. pose: [4,4] float64, of the rig's centre camera, coordinates of the fit. depth: of the zero
    plane in it. low, high: (x, y) at depth 1 of the window's corners."""

    pose: np.ndarray
    depth: float
    low: tuple[float, float]
    high: tuple[float, float]

    @classmethod
    def of(cls, display: Display, world: World) -> Frame:
        """Of the display's rig, at the panel's resolution."""
        rig, panel = display.rig, display.panel
        (fx, fy), (cx, cy) = rig.focal_px, rig.principal_point_px
        (pose,) = world.poses(rig.world_to_camera[None])
        low, high = (-cx / fx, -cy / fy), ((panel.width_px - cx) / fx, (panel.height_px - cy) / fy)
        return cls(pose, rig.zero_depth / world.extent, low, high)

    def pixels(self, world_to_camera: Tensor, intrinsics: Tensor, width_px: int, height_px: int) -> Tensor:
        """[H,W] bool: which pixels of a photograph, by its pose [4,4] and (fx, fy, cx, cy) [4], coordinates of the fit,
        have rays that go through the window."""
        device = world_to_camera.device
        to_rig = torch.from_numpy(self.pose).to(device) @ torch.linalg.inv(world_to_camera.double())
        fx, fy, cx, cy = intrinsics.double()
        x = (torch.arange(width_px, dtype=torch.float64, device=device) + 0.5 - cx) / fx
        y = (torch.arange(height_px, dtype=torch.float64, device=device) + 0.5 - cy) / fy
        y, x = torch.meshgrid(y, x, indexing="ij")
        rays = torch.stack([x, y, torch.ones_like(x)], -1)
        rays, place = rays @ to_rig[:3, :3].T, to_rig[:3, 3]
        steps = (self.depth - place[2]) / rays[..., 2]
        met = (place[:2] + steps[..., None] * rays[..., :2]) / self.depth
        low, high = (torch.tensor(corner, dtype=torch.float64, device=device) for corner in (self.low, self.high))
        return ((met >= low) & (met <= high)).all(-1) & (steps > 0) & (rays[..., 2] > 0)


def framed(views: Views, frame: Frame, inside: Sequence[bool]) -> tuple[Views, float] | None:
    """Those of the views that are `inside` [C], in which pixels count that are in the frame and counted before, and the
    share 0..1 of all their pixels that do; None where no pixel does."""
    weights = torch.zeros(views.photos.shape[:3], dtype=torch.uint8, device=views.photos.device)  # perhaps the host's
    for place, (width, height) in enumerate(views.sizes):
        seen = frame.pixels(views.world_to_camera[place], views.intrinsics[place], width, height)
        counts = 255 if views.weights is None else views.weights[place, :height, :width]
        weights[place, :height, :width] = seen.to(weights.device) * counts
    places = [place for place, is_inside in enumerate(inside) if is_inside and bool(weights[place].any())]
    if not places:
        return None
    pixels = sum(views.sizes[place][0] * views.sizes[place][1] for place in places)
    kept = replace(views.some(places), weights=weights[places])
    return kept, float((weights[places] > 0).sum()) / pixels
