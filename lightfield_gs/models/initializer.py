"""First stage of the network: colour, mask and ray of each pixel, before anything is predicted."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Pixels:
    """The pixels of a picture.

    Attributes:
        rays: [B,2,H,W], x/z and y/z of the line of sight through the pixel's centre (source camera's axes).
        footprint: [B,1,1,1], width of a pixel at depth 1, in scene units.
        colour: [B,3,H,W], straight (not premultiplied), mid-grey where the mask is 0.
        mask: [B,1,H,W], 0..1.
    """

    rays: Tensor
    footprint: Tensor
    colour: Tensor
    mask: Tensor


def pixel_rays(intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Return directions (x/z, y/z) through pixel centres.

    Args:
        intrinsics: [B,4], (fx, fy, cx, cy) in pixels.
        height, width: of the picture, pixels.

    Returns:
        [B,2,H,W].
    """
    fx, fy, cx, cy = (value[:, None, None] for value in intrinsics.unbind(-1))
    columns = torch.arange(width, device=intrinsics.device, dtype=intrinsics.dtype) + 0.5
    rows = torch.arange(height, device=intrinsics.device, dtype=intrinsics.dtype) + 0.5
    x = ((columns[None, None, :] - cx) / fx).expand(-1, height, -1)
    y = ((rows[None, :, None] - cy) / fy).expand(-1, -1, width)
    return torch.stack([x, y], dim=1)


def describe_pixels(images: Tensor, intrinsics: Tensor) -> Pixels:
    """Unpack pictures.

    Args:
        images: [B,4,H,W] in 0..1, premultiplied.
        intrinsics: [B,4], (fx, fy, cx, cy) in pixels.
    """
    mask = images[:, 3:]
    # Dividing by at least 1/50 keeps rounding noise in faint pixels from becoming bright colours.
    colour = torch.where(mask > 0.02, (images[:, :3] / mask.clamp_min(0.02)).clamp(0, 1), 0.5)
    rays = pixel_rays(intrinsics, *images.shape[2:])
    return Pixels(rays, (1 / intrinsics[:, 0])[:, None, None, None], colour, mask)


def flat(channels: Tensor) -> Tensor:
    """Reshape [B,C,H,W] to [B,H*W,C]."""
    return channels.flatten(2).transpose(1, 2)


def network_input(images: Tensor, pixels: Pixels, kind: str) -> Tensor:
    """Return the input channels of the U-Net.

    Args:
        images: [B,4,H,W], premultiplied.
        pixels: of the same images.
        kind: "rgb_mask_ray" for [B,6,H,W] about zero, or "rgb" for [B,3,H,W] on white in 0..1.
    """
    if kind == "rgb":
        return images[:, :3] + 1 - pixels.mask
    # Premultiplied colour on mid-grey, minus mid-grey: zero in the background.
    return torch.cat([images[:, :3] - 0.5 * pixels.mask, pixels.mask - 0.5, pixels.rays], dim=1)


def mirror_image(images: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Reflect images and their cameras, left and right.

    Args:
        images: [B,4,H,W].
        intrinsics: [B,4], (fx, fy, cx, cy) in pixels.
    """
    fx, fy, cx, cy = intrinsics.unbind(-1)
    return images.flip(3), torch.stack([fx, fy, images.shape[3] - cx, cy], dim=-1)
