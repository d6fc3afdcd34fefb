"""The loss of rendered images against photographs, L1 and SSIM, with its gradient (csrc/math/fit/photo_loss.h)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.checks import expect, real_number
from lightfield_gs.base.cuda import device_guard
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.native import check_tensor, core_of, optional_address, stream_of


def photo_loss_and_gradient(
    image: Tensor, photo: Tensor, weights: Tensor | None = None, ssim_lambda: float = 0.2
) -> tuple[Tensor, Tensor]:
    """The loss, a tensor without dimensions, and its gradient with respect to the image, [V,H,W,3], without autograd.

    image [V,H,W,3]: rendered views, of any finite values; float32, on the CPU also float64. photo [V,H,W,3]: what they
    should be, 0..1 in the dtype of the image, or uint8 in steps of 1/255. weights [V,H,W] float32 in 0..1, or None for
    1: how much each pixel counts. All on one device.

    With w the weights, x the image, y the photo and x' = w x + (1 - w) y, the loss is the sum over the views of
    (1 - ssim_lambda) mean |x' - y| + ssim_lambda mean (w (1 - SSIM(x', y))), means over 3 H W numbers: a photo of which
    little counts weighs little. What has no weight looks as in the photo, also to the windows of its neighbours. SSIM
    is that of Wang et al. 2004, equation 13, with an 11 x 11 Gaussian window of sigma 1.5 and zeros beyond the image
    (as reference.ssim); the mix is that of Kerbl et al. 2023, equation 7. Sums have a fixed order: the same input gives
    the same bits, on any number of threads. On CUDA all work is on torch's current stream, and can be captured.

    Raises InputError for other shapes, dtypes or devices, and for a share outside 0..1.
    """
    job = _Job(image.detach() if isinstance(image, Tensor) else image, photo, weights, ssim_lambda)
    return job.run()


def photo_loss(image: Tensor, photo: Tensor, weights: Tensor | None = None, ssim_lambda: float = 0.2) -> Tensor:
    """The loss of photo_loss_and_gradient with its gradient to the image in autograd; the gradient is not
    differentiable again."""
    expect("image", image, Tensor)
    return _PhotoLoss.apply(image, photo, weights, ssim_lambda)


class _PhotoLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, photo: Tensor, weights: Tensor | None, ssim_lambda: float) -> Tensor:
        loss, gradient = photo_loss_and_gradient(image, photo, weights, ssim_lambda)
        ctx.save_for_backward(gradient)
        return loss

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, g_loss: Tensor) -> tuple[Tensor, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return g_loss * gradient, None, None, None


class _Job:
    """The checked arguments, and the buffers of the stage."""

    def __init__(self, image: Tensor, photo: Tensor, weights: Tensor | None, ssim_lambda: float):
        expect("image", image, Tensor)
        if image.dim() != 4 or image.shape[3] != 3 or not image.numel():
            raise InputError(f"image must be [V,H,W,3] with at least one pixel, got {list(image.shape)}")
        self.core, shape, device = core_of("image", image), image.shape, image.device
        expect("photo", photo, Tensor)
        dtype = torch.uint8 if photo.dtype == torch.uint8 else image.dtype
        self.image = image.contiguous()
        self.photo = check_tensor("photo", photo, shape, dtype, device)
        self.weights = None
        if weights is not None:
            self.weights = check_tensor("weights", weights, shape[:3], torch.float32, device)
        self.ssim_lambda = real_number("ssim_lambda", ssim_lambda, 0, 1)

    def run(self) -> tuple[Tensor, Tensor]:
        image, photo, sizes = self.image, self.photo, tuple(self.image.shape[:3])
        with device_guard(image.device):
            stages = _core.cuda if image.is_cuda else _core
            derivatives = image.new_empty(3, *image.shape)
            partials = image.new_empty(stages.photo_loss_partials(*sizes), dtype=torch.float64)
            loss, gradient = image.new_empty(()), torch.empty_like(image)
            job = self.core.PhotoLoss(
                images=sizes[0],
                height_px=sizes[1],
                width_px=sizes[2],
                image=image.data_ptr(),
                photo=0 if photo.dtype == torch.uint8 else photo.data_ptr(),
                photo_bytes=photo.data_ptr() if photo.dtype == torch.uint8 else 0,
                weights=optional_address(self.weights),
                ssim_lambda=self.ssim_lambda,
                derivatives=derivatives.data_ptr(),
                partials=partials.data_ptr(),
                loss=loss.data_ptr(),
                gradient=gradient.data_ptr(),
            )
            if image.is_cuda:
                _core.cuda.photo_loss(job, stream_of(image.device))
            else:
                self.core.photo_loss(job, torch.get_num_threads())
        return loss, gradient
