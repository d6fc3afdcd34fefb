"""What training minimises."""
from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from training.metrics import ssim


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms: squared colour error, 1 - SSIM, squared error of the object's outline (alpha)."""
    colour: float = 1.0
    ssim: float = 0.05
    alpha: float = 0.1


def composite(premultiplied: Tensor, backgrounds: Tensor) -> Tensor:
    """Premultiplied RGBA [B,V,4,H,W] over plain backgrounds [B,V,3]: [B,V,3,H,W]."""
    return premultiplied[:, :, :3] + (1 - premultiplied[:, :, 3:]) * backgrounds[..., None, None]


def total_loss(images: Tensor, alpha: Tensor, targets: Tensor, backgrounds: Tensor,
               weights: LossWeights) -> tuple[Tensor, dict[str, Tensor]]:
    """The weighted sum and its unweighted terms.

    images: rendered [B,V,3,H,W] over backgrounds [B,V,3]. alpha: rendered opacity [B,V,H,W]. targets: [B,V,4,H,W]
    premultiplied RGBA.
    """
    wanted = composite(targets, backgrounds)
    terms = {"colour": (images - wanted).square().mean(), "alpha": (alpha - targets[:, :, 3]).square().mean()}
    if weights.ssim:
        terms["ssim"] = 1 - ssim(images, wanted).mean()
    total = torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum()
    return total, {name: term.detach() for name, term in terms.items()}
