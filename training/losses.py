"""The loss of training."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.reference.metrics import ssim
from training.coverage import inside_and_outside
from training.ranges import check_ranges

_LEAST_ERROR = 1e-4  # of an image, 40 dB: better ones count no more in the logarithm


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms of the loss, at least 0, not all 0.

    Args:
        colour: of the squared colour error.
        log_colour: of the logarithm of each image's squared colour error, which PSNR averages: images count alike
            however large their errors. At an error of 0.002 (27 dB) it has the slope of the squared error if its weight
            is 0.002 times as large.
        gradient: of the squared error of the colours' differences between neighbouring pixels, as in gradient_psnr_db.
            A soft picture of a sharp edge then costs more than by its squared error. It helps most with targets as
            large as the source pictures (target_px), which have the detail.
        ssim: of 1 - SSIM.
        alpha: of the squared error of the object's outline.
        translucency: of half transparent pixels. Where the network cannot know whether a pixel is object, the squared
            error is least at the probability of that: a halo. This term makes it decide. Its weight against the weights
            of the squared errors sets how much sharper outlines get.
        outline: of the error of the object's outline (not squared) inside and outside it, but for a band along it.
            These are holes and ghosts. An error that is not squared is least at a decision too.
        roughness: of the roughness of depth.
    """

    colour: float = 1.0
    log_colour: float = 0.0
    gradient: float = 0.0
    ssim: float = 0.05
    alpha: float = 0.1
    translucency: float = 0.0
    outline: float = 0.0
    roughness: float = 0.0

    def __post_init__(self) -> None:
        weights = dataclasses.asdict(self)
        check_ranges(self, "loss.", **dict.fromkeys(weights, (0.0, 1e6)))
        if not any(weights.values()):
            raise InputError("loss: expected a weight above 0, got none")


def composite(premultiplied: Tensor, backgrounds: Tensor) -> Tensor:
    """Premultiplied RGBA [B,V,4,H,W] over plain backgrounds [B,V,3]: [B,V,3,H,W]."""
    return premultiplied[:, :, :3] + (1 - premultiplied[:, :, 3:]) * backgrounds[..., None, None]


def roughness(means: Tensor, source: Tensor) -> Tensor:
    """Return how much the disparity 1/z of Gaussians differs between neighbouring pixels of the object, scene units^-1.

    Where the depth is uncertain, squared error rewards neighbours scattered over it, which show as dots in magnified
    views. Differences count less across edges of the picture, where depth may jump. Every example counts alike,
    whatever
    the size of its object.

    Args:
        means: [B,N,3] in the source camera's axes, N = layers * H * W.
        source: [B,4,H,W] premultiplied RGBA.
    """
    batch, _, height, width = source.shape
    disparity = 1 / means[..., 2].view(batch, -1, height, width)
    total = torch.zeros((), device=means.device)
    for dim in (2, 3):
        ahead, behind = (source.narrow(dim, start, source.shape[dim] - 1) for start in (1, 0))
        inside = ahead[:, 3:] * behind[:, 3:]
        weight = inside * torch.exp(-10 * (ahead - behind)[:, :3].abs().mean(1, keepdim=True))
        pairs = (inside.sum((1, 2, 3)) * disparity.shape[1]).clamp_min(1)
        total = total + ((weight * disparity.diff(dim=dim).abs()).sum((1, 2, 3)) / pairs).mean()
    return total


def gradient_error(images: Tensor, wanted: Tensor) -> Tensor:
    """The mean squared error of the differences to the right and to the lower neighbour, of images [...,H,W]."""
    errors = images - wanted
    return (errors.diff(dim=-1).square().mean() + errors.diff(dim=-2).square().mean()) / 2


def translucency(alpha: Tensor) -> Tensor:
    """Return how far pixels are from being object or background: the mean of alpha (1 - alpha), 0 to 1/4.

    Args:
        alpha: Opacities of any shape, 0..1.
    """
    return (alpha * (1 - alpha)).mean()


def outline_error(alpha: Tensor, truth: Tensor) -> Tensor:
    """Return the mean error of opacities [B,V,H,W], counted where pixels are surely inside or outside the object."""
    inside, outside = (mask.view_as(alpha) for mask in inside_and_outside(truth.flatten(0, 1)))
    return ((alpha - truth).abs() * (inside | outside)).mean()


def total_loss(
    images: Tensor,
    alpha: Tensor,
    targets: Tensor,
    backgrounds: Tensor,
    means: Tensor,
    source: Tensor,
    weights: LossWeights,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted sum and its unweighted terms.

    Args:
        images: Rendered [B,V,3,H,W] over the backgrounds.
        alpha: Rendered opacity [B,V,H,W].
        targets: [B,V,4,H,W] premultiplied RGBA.
        backgrounds: [B,V,3].
        means, source: See roughness.
    """
    wanted = composite(targets, backgrounds)
    errors = (images - wanted).square().mean((2, 3, 4))
    terms = {"colour": errors.mean(), "alpha": (alpha - targets[:, :, 3]).square().mean()}
    if weights.log_colour:
        terms["log_colour"] = (errors + _LEAST_ERROR).log().mean()
    if weights.gradient:
        terms["gradient"] = gradient_error(images, wanted)
    if weights.ssim:
        terms["ssim"] = 1 - ssim(images, wanted).mean()
    if weights.translucency:
        terms["translucency"] = translucency(alpha)
    if weights.outline:
        terms["outline"] = outline_error(alpha, targets[:, :, 3])
    if weights.roughness:
        terms["roughness"] = roughness(means, source)
    total = torch.stack([getattr(weights, name) * term for name, term in terms.items()]).sum()
    return total, {name: term.detach() for name, term in terms.items()}
