"""The rasterizer as training sees it: batches of objects and cameras; and the card that a network has to beat."""

from __future__ import annotations

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs import Cameras, Gaussians, render


def render_views(
    gaussians: Gaussians,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    width_px: int,
    height_px: int,
    backgrounds: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return images [B,V,3,H,W] over plain backgrounds [B,V,3], and opacities [B,V,H,W]; float32, differentiable.

    Args:
        gaussians: With leading B.
        world_to_camera: [B,V,4,4].
        intrinsics: [B,V,4] as (fx, fy, cx, cy) in pixels.
    """
    cameras = Cameras(world_to_camera, intrinsics[..., :2], intrinsics[..., 2:], width_px, height_px)
    with torch.autocast(world_to_camera.device.type, enabled=False):
        images = render(gaussians, cameras, background=backgrounds, alpha=True)
    return images.image.permute(0, 1, 4, 2, 3), cast(Tensor, images.alpha)


def render_card(
    picture: Tensor, source_intrinsics: Tensor, depth: float, world_to_camera: Tensor, intrinsics: Tensor
) -> Tensor:
    """Draw a picture as a flat card, upright before its own camera at a depth, as other cameras see it: [V,C,H,W].

    The result is bilinear, and zero beyond the card and where it is behind a camera.

    Args:
        picture: [C,H,W].
        source_intrinsics: [4], (fx, fy, cx, cy) in pixels.
        world_to_camera: [V,4,4], the world being the axes of the picture's camera.
        intrinsics: [V,4].
    """
    height, width = picture.shape[1:]
    columns, rows = (torch.arange(size, device=picture.device) + 0.5 for size in (width, height))
    fx, fy, cx, cy = intrinsics[:, :, None, None].unbind(1)
    x, y = torch.broadcast_tensors((columns - cx) / fx, (rows[:, None] - cy) / fy)
    rotation, translation = world_to_camera[:, :3, :3], world_to_camera[:, :3, 3]
    # A camera's centre is -R^T t, and the point in its pixel is the centre + distance * R^T (x, y, 1).
    centres = -torch.einsum("vij,vi->vj", rotation, translation)[:, None, None]
    rays = torch.einsum("vij,vhwi->vhwj", rotation, torch.stack([x, y, torch.ones_like(x)], -1))
    distances = (depth - centres[..., 2]) / rays[..., 2]
    points = (centres + distances[..., None] * rays)[..., :2] / depth
    pixels = points * source_intrinsics[:2] + source_intrinsics[2:]
    places = 2 * pixels / torch.tensor([width, height], device=picture.device) - 1
    seen = F.grid_sample(picture.expand(len(intrinsics), -1, -1, -1), places, align_corners=False)
    return seen * (distances > 0)[:, None]
