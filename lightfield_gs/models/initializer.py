"""First stage of the network: what is known of each pixel before anything was predicted."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Pixels:
    """What the picture says about each pixel of a grid.

    rays: [B,2,H,W], x/z and y/z of the line of sight through the pixel's centre (source camera's axes).
    footprint: [B,1,1,1], width of a pixel at depth 1, in scene units. colour: [B,3,H,W], straight (not premultiplied),
    mid-grey where nothing is. mask: [B,1,H,W], 0..1.
    """

    rays: Tensor
    footprint: Tensor
    colour: Tensor
    mask: Tensor


def pixel_rays(intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Directions (x/z, y/z) through pixel centres, [B,2,H,W]. intrinsics: [B,4] as (fx, fy, cx, cy) in pixels."""
    fx, fy, cx, cy = (value[:, None, None] for value in intrinsics.unbind(-1))
    columns = torch.arange(width, device=intrinsics.device, dtype=intrinsics.dtype) + 0.5
    rows = torch.arange(height, device=intrinsics.device, dtype=intrinsics.dtype) + 0.5
    x = ((columns[None, None, :] - cx) / fx).expand(-1, height, -1)
    y = ((rows[None, :, None] - cy) / fy).expand(-1, -1, width)
    return torch.stack([x, y], dim=1)


def describe_pixels(images: Tensor, intrinsics: Tensor) -> Pixels:
    """Unpack premultiplied images [B,4,H,W] (0..1) and intrinsics [B,4] (fx, fy, cx, cy in pixels)."""
    mask = images[:, 3:]
    # Dividing by at least 1/50 keeps rounding noise in faint pixels from becoming bright colours.
    colour = torch.where(mask > 0.02, (images[:, :3] / mask.clamp_min(0.02)).clamp(0, 1), 0.5)
    rays = pixel_rays(intrinsics, *images.shape[2:])
    return Pixels(rays, (1 / intrinsics[:, 0])[:, None, None, None], colour, mask)


def network_input(images: Tensor, pixels: Pixels, kind: str) -> Tensor:
    """Input channels of the U-Net: "rgb_mask_ray" [B,6,H,W] about zero, or "rgb" [B,3,H,W] on white in 0..1."""
    if kind == "rgb":
        return images[:, :3] + 1 - pixels.mask
    # Premultiplied colour on mid-grey, less mid-grey: zero where nothing is.
    return torch.cat([images[:, :3] - 0.5 * pixels.mask, pixels.mask - 0.5, pixels.rays], dim=1)


def mirror_image(images: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """What images [B,4,H,W] and their intrinsics [B,4] are in a mirror that exchanges left and right."""
    fx, fy, cx, cy = intrinsics.unbind(-1)
    return images.flip(3), torch.stack([fx, fy, images.shape[3] - cx, cy], dim=-1)
