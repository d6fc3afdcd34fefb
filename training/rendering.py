"""The rasterizer as training sees it: batches of objects and cameras."""
from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs import Cameras, Gaussians, render


def render_views(gaussians: Gaussians, world_to_camera: Tensor, intrinsics: Tensor, width_px: int, height_px: int,
                 backgrounds: Tensor) -> tuple[Tensor, Tensor]:
    """Images [B,V,3,H,W] over plain backgrounds [B,V,3], and opacities [B,V,H,W]; float32, differentiable.

    gaussians: with leading B. world_to_camera: [B,V,4,4]. intrinsics: [B,V,4] as (fx, fy, cx, cy) in pixels.
    """
    cameras = Cameras(world_to_camera, intrinsics[..., :2], intrinsics[..., 2:], width_px, height_px)
    with torch.autocast(world_to_camera.device.type, enabled=False):
        images, alpha = render(gaussians, cameras, background=backgrounds, alpha=True)
    return images.permute(0, 1, 4, 2, 3), alpha
