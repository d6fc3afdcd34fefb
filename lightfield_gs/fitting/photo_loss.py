"""The loss of rendered images against photographs, L1 and SSIM, with its gradient (csrc/math/fit/photo_loss.h)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import check_tensor
from lightfield_gs.base.checks import expect, real_number, shown
from lightfield_gs.base.device import device_guard
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.stages import optional_address, run_stage, select_stages
from lightfield_gs.rasterizer.operators import differentiable_once

# A loss of one's own, without dimensions: of renders [V,H,W,3], photographs [V,H,W,3] in 0..1, and weights [V,H,W] in
# 0..1 of their pixels (None: 1); summed over V
Loss = Callable[[Tensor, Tensor, Tensor | None], Tensor]


def own_loss_and_gradient(
    loss: Loss, image: Tensor, photo: Tensor, weights: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return a loss of one's own and its gradient by the image, by autograd.

    Args:
        loss: see Loss.
        image: [V,H,W,3] float32.
        photo: [V,H,W,3], 0..1, or uint8 in steps of 1/255.
        weights: [V,H,W].

    Raises:
        InputError: it returns no number that depends on the image.
    """
    leaf = image.detach().requires_grad_()
    with torch.enable_grad():
        value = loss(leaf, photo / 255 if photo.dtype == torch.uint8 else photo, weights)
    if not isinstance(value, Tensor) or value.numel() != 1 or not value.requires_grad:
        found = f"a tensor {list(value.shape)}" if isinstance(value, Tensor) else shown(value)
        raise InputError(f"loss: expected one number that depends on the image by torch's operations, got {found}")
    (gradient,) = torch.autograd.grad(value, leaf)
    return value.detach().reshape(()).to(image), gradient.contiguous()


def photo_loss_and_gradient(
    image: Tensor, photo: Tensor, weights: Tensor | None = None, ssim_lambda: float = 0.2
) -> tuple[Tensor, Tensor]:
    """Return the loss and its gradient by the image, without autograd.

    With weights w, image x, photo y and x' = w x + (1 - w) y, the loss is the sum over the images of

        (1 - ssim_lambda) mean |x' - y| + ssim_lambda mean (w (1 - SSIM(x', y)))

    with means over 3 H W numbers (Kerbl et al. 2023, equation 7). A photo with few counting pixels has little weight.
    Pixels without weight look as in the photo, also to the windows of their neighbours. SSIM is equation 13 of Wang et
    al. 2004, with an 11 x 11 Gaussian window of sigma 1.5 and zeros beyond the image, as in reference.ssim. Sums have a
    fixed order: the same input gives the same bits on any number of threads. On CUDA all work is in torch's current
    stream, and can be captured.

    Args:
        image: [V,H,W,3], rendered images of any finite values; float32, on the CPU also float64.
        photo: [V,H,W,3], 0..1 in the dtype of the image, or uint8 in steps of 1/255.
        weights: [V,H,W] float32 in 0..1, of each pixel; None: 1.
        ssim_lambda: 0..1, weight of SSIM.

    Returns:
        The loss, a tensor without dimensions, and its gradient [V,H,W,3].

    Raises:
        InputError: another shape, dtype or device, or ssim_lambda outside 0..1.
    """
    expect("image", image, Tensor)
    image = image.detach()
    if image.dim() != 4 or image.shape[3] != 3 or not image.numel():
        raise InputError(f"image must be [V,H,W,3] with at least one pixel, got {list(image.shape)}")
    stages, shape, device = select_stages("image", image), image.shape, image.device
    expect("photo", photo, Tensor)
    is_bytes = photo.dtype == torch.uint8
    image, photo = (
        image.contiguous(),
        check_tensor("photo", photo, shape, torch.uint8 if is_bytes else image.dtype, device),
    )
    if weights is not None:
        weights = check_tensor("weights", weights, shape[:3], torch.float32, device)
    ssim_lambda = real_number("ssim_lambda", ssim_lambda, 0, 1)
    count, height, width = shape[:3]
    with device_guard(device):
        partials = (_core.cuda if image.is_cuda else _core).photo_loss_partials(count, height, width)
        derivatives, sums = image.new_empty(3, *shape), image.new_empty(partials, dtype=torch.float64)
        loss, gradient = image.new_empty(()), torch.empty_like(image)
        job = stages.PhotoLoss(
            images=count,
            height_px=height,
            width_px=width,
            image=image.data_ptr(),
            photo=0 if is_bytes else photo.data_ptr(),
            photo_bytes=photo.data_ptr() if is_bytes else 0,
            weights=optional_address(weights),
            ssim_lambda=ssim_lambda,
            derivatives=derivatives.data_ptr(),
            partials=sums.data_ptr(),
            loss=loss.data_ptr(),
            gradient=gradient.data_ptr(),
        )
        run_stage("photo_loss", stages, device, job)
    return loss, gradient


def photo_loss(image: Tensor, photo: Tensor, weights: Tensor | None = None, ssim_lambda: float = 0.2) -> Tensor:
    """Return the loss of photo_loss_and_gradient with autograd by the image, differentiable once.

    Args:
        image: [V,H,W,3].
        photo: [V,H,W,3].
        weights: [V,H,W]; None: 1.
        ssim_lambda: 0..1, weight of SSIM.

    Raises:
        InputError: see photo_loss_and_gradient.
    """
    expect("image", image, Tensor)
    return _PhotoLoss.apply(image, photo, weights, ssim_lambda)


class _PhotoLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, photo: Tensor, weights: Tensor | None, ssim_lambda: float) -> Tensor:
        loss, gradient = photo_loss_and_gradient(image, photo, weights, ssim_lambda)
        ctx.save_for_backward(gradient, image)
        return loss

    @staticmethod
    @differentiable_once
    def backward(ctx: Any, g_loss: Tensor) -> tuple[Tensor, None, None, None]:
        gradient, _ = ctx.saved_tensors
        return g_loss * gradient, None, None, None
