"""The perceptual loss WD-R: Wasserstein Distortion of VGG-16's features, with L1 and SSIM.

Wasserstein Distortion (Qiu, Wagner, Ballé & Theis 2024, arXiv 2310.03629) compares the mean and the standard deviation
of features in windows of size sigma: texture may move within a window, but has to be there. Features, scales, the
normalisation and windows are those of Ballé et al. 2025 (arXiv 2412.00505), from the packages google/codex,
balle-lab/codex and balle-lab/wasserstein-distortion:

    features    the image itself, and the last activations of VGG-16's five blocks at each of three scales; averages in
                place of maxima between blocks
    windows     repeated filters [1 2 1] / 4 in both directions, with a step of 2 but for the last one, zeros outside

Özyilkan et al. 2026 (arXiv 2603.23297) fit Gaussians by it. They add L1 and SSIM at a low weight, since the distortion
alone draws webs where photographs are few, and call the sum WD-R; raters preferred it to L1 and SSIM 2.3 : 1. Neither
abstract nor project page tells their sigma and weights, and whether they change over a fit; see those below.

The network is seen three times in a step: forward for photograph and render, and backward. With V photographs of
H x W pixels that is 3 x 1.31 x 0.61 MFLOP V H W: 740 GFLOP for one of 640 x 480.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.checkpoint import checkpoint

from lightfield_gs.fitting import vgg16
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient

SCALES = 3
# These numbers were chosen by the LPIPS of banana; solids-arc-1 and solids-round-1 had no part, see docs/scenes.md
FIRST_STEPS = 0.5  # of all steps go by L1 and SSIM alone: the distortion places nothing
LOG2_SIGMA = 2  # windows of 2^2 pixels of a photograph; the example of balle-lab/wasserstein-distortion has 2^4
# The distortion's gradient is then about as long as that of L1 and SSIM, so that regularisers and limits on gradients
# keep their balance: averaged over 4 x 4 pixels, it was 400 times as long in the first step of a fit of banana (160
# pixels, windows of 2^4), and 160 times in the last
DISTORTION_WEIGHT, PIXEL_WEIGHT = 0.005, 1.0
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet's colours, as torchvision's weights expect
_LEAST_VARIANCE = 1e-6  # added to variances: gradients of their roots stay finite


class WassersteinLoss:
    """WD-R with the weights of VGG-16 on a device."""

    def __init__(self, vgg: vgg16.Vgg16, ssim_lambda: float = 0.2):
        """Keep the network, and the weight 0..1 of SSIM beside L1."""
        self._vgg, self._ssim_lambda = vgg, ssim_lambda
        first = vgg[0][0].weight
        self._mean, self._std = (first.new_tensor(numbers).view(1, 3, 1, 1) for numbers in (_MEAN, _STD))

    def __call__(self, image: Tensor, photo: Tensor, weights: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return the loss, without dimensions, and its gradient by the image.

        Pixels without weight look as in the photograph, as in photo_loss. On CUDA the work waits for nothing and can be
        captured; convolutions round factors to TF32, and their sums are float32 in a fixed order.

        Args:
            image: [V,H,W,3] renders.
            photo: [V,H,W,3], 0..1, or uint8 in steps of 1/255.
            weights: [V,H,W] in 0..1 of each pixel; None: 1.
        """
        pixel_loss, pixel_gradient = photo_loss_and_gradient(image, photo, weights, self._ssim_lambda)
        leaf = image.detach().requires_grad_()
        with torch.enable_grad(), torch.backends.cudnn.flags(enabled=True, deterministic=True):
            value = self.distortion(leaf, photo / 255 if photo.dtype == torch.uint8 else photo, weights)
            (gradient,) = torch.autograd.grad(value, leaf)
        loss = PIXEL_WEIGHT * pixel_loss + DISTORTION_WEIGHT * value.detach()
        return loss, (PIXEL_WEIGHT * pixel_gradient + DISTORTION_WEIGHT * gradient).contiguous()

    def distortion(self, image: Tensor, photo: Tensor, weights: Tensor | None = None) -> Tensor:
        """Return the Wasserstein Distortion, summed over the images; differentiable by the image.

        It is the sum over the arrays of features of the mean over channels and pixels of (m - m')^2 + (s - s')^2, with
        mean m and standard deviation s in the window of a pixel.

        Args:
            image: [V,H,W,3] of floats.
            photo: [V,H,W,3] of its dtype.
            weights: [V,H,W]; None: 1.
        """
        if weights is not None:
            image = photo + weights[..., None].to(image) * (image - photo)
        with torch.no_grad():
            expected = [_moments(array, level) for array, level in self._arrays(photo)]
        distances = []
        for (array, level), (mean, deviation) in zip(self._arrays(image), expected):
            found = checkpoint(_moments, array, level, use_reentrant=False, preserve_rng_state=False)
            distance = (found[0] - mean).square().mean()
            distances.append(distance if level == 0 else distance + (found[1] - deviation).square().mean())
        return len(image) * torch.stack(distances).sum()

    def _arrays(self, image: Tensor) -> Iterator[tuple[Tensor, int]]:
        """Yield the features of images [V,H,W,3], and the level of their windows: log2 sigma in their own pixels."""
        current = (image.permute(0, 3, 1, 2) - self._mean) / self._std
        yield current, LOG2_SIGMA
        for scale in range(SCALES):
            if scale:
                current = _smooth(current, 2)
            for block, array in enumerate(vgg16.features(self._vgg, current)):
                yield array, max(0, LOG2_SIGMA - scale - block)


def load_loss(ssim_lambda: float, device: torch.device | str) -> WassersteinLoss:
    """Return the loss on a device; fetch the weights of VGG-16 if they are not here.

    Args:
        ssim_lambda: 0..1, weight of SSIM beside L1.
        device: of the fit.

    Raises:
        InputError: they cannot be fetched or read.
    """
    return WassersteinLoss(vgg16.read_weights(vgg16.fetch_weights(print), device), ssim_lambda)


def _moments(array: Tensor, level: int) -> tuple[Tensor, Tensor]:
    """Return means and standard deviations of features [N,C,H,W] in windows of 2^level of their pixels.

    At level 0 windows are single pixels: the deviation is 0, and the mean is the features.
    """
    if level == 0:
        return array, array.new_zeros(())
    mean, square = array, array.square()
    for stride in (*[2] * (level - 1), 1):
        mean, square = _smooth(mean, stride), _smooth(square, stride)
    # Rounding can make a difference of equal numbers negative
    return mean, (torch.relu(square - mean.square()) + _LEAST_VARIANCE).sqrt()


def _smooth(array: Tensor, stride: int) -> Tensor:
    """Filter [N,C,H,W] by [1 2 1] / 4 in both directions, two averages of two, with zeros outside."""
    return functional.avg_pool2d(functional.avg_pool2d(array, 2, stride=1, padding=1), 2, stride=stride)
