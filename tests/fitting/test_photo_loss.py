"""The fused loss of images against photographs: its value, its gradient, and its weights."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.photo_loss import photo_loss, photo_loss_and_gradient
from lightfield_gs.reference.metrics import ssim


def make_images(count: int, height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Images, some of whose values are outside 0..1, and photos; float64."""
    random = torch.Generator().manual_seed(seed)
    photo = torch.rand(count, height, width, 3, dtype=torch.float64, generator=random)
    noise = torch.randn(photo.shape, dtype=torch.float64, generator=random)
    return photo + 0.3 * noise, photo


def plain_loss(image: Tensor, photo: Tensor, ssim_lambda: float) -> Tensor:
    """By torch and the oracle of SSIM, summed over images."""
    similarity = ssim(image.movedim(-1, 1), photo.movedim(-1, 1))
    return ((1 - ssim_lambda) * (image - photo).abs().mean((1, 2, 3)) + ssim_lambda * (1 - similarity)).sum()


@pytest.mark.parametrize("size", [(1, 1, 1), (2, 4, 7), (3, 37, 50)])
@pytest.mark.parametrize("ssim_lambda", [0.0, 0.2, 1.0])
def test_loss_and_gradient_are_those_of_plain_torch(size, ssim_lambda):
    image, photo = make_images(*size)
    image.requires_grad_()
    expected = plain_loss(image, photo, ssim_lambda)
    (gradient,) = torch.autograd.grad(expected, image)
    loss, found = photo_loss_and_gradient(image, photo, ssim_lambda=ssim_lambda)
    torch.testing.assert_close(loss, expected.detach(), rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(found, gradient, rtol=1e-9, atol=1e-14)
    loss32, found32 = photo_loss_and_gradient(image.detach().float(), photo.float(), ssim_lambda=ssim_lambda)
    torch.testing.assert_close(loss32.double(), expected.detach(), rtol=1e-5, atol=1e-7)
    assert (found32.double() - gradient).norm() <= 1e-4 * gradient.norm()


@pytest.mark.parametrize("weighted", [False, True])
def test_gradient_passes_gradcheck(weighted):
    image, photo = make_images(2, 5, 8)
    weights = torch.rand(2, 5, 8, generator=torch.Generator().manual_seed(1)) if weighted else None
    if weighted:
        weights[0, 1:3] = 0
    assert torch.autograd.gradcheck(lambda x: 3 * photo_loss(x, photo, weights), image.requires_grad_())


def test_a_second_derivative_is_refused():
    image, photo = make_images(2, 5, 8)
    leaf = image.requires_grad_()
    (gradient,) = torch.autograd.grad(photo_loss(leaf, photo, None), leaf, create_graph=True)
    with pytest.raises(InputError, match="differentiable once"):
        gradient.square().sum().backward()


def test_bytes_count_as_255ths():
    image, _ = make_images(1, 12, 9)
    photo = torch.randint(0, 256, image.shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(2))
    for found, expected in zip(
        photo_loss_and_gradient(image, photo), photo_loss_and_gradient(image, photo.double() / 255)
    ):
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-15)


def test_what_has_no_weight_says_nothing():
    image, photo = make_images(1, 20, 24)
    weights = torch.ones(1, 20, 24)
    weights[:, 6:15, 10:] = 0
    hidden = weights[..., None] == 0
    loss, gradient = photo_loss_and_gradient(image, photo, weights)
    assert (gradient[hidden.expand_as(gradient)] == 0).all()
    other = torch.where(hidden, torch.tensor(float("nan"), dtype=torch.float64), image)
    again, same = photo_loss_and_gradient(other, photo, weights)
    assert torch.equal(loss, again) and torch.equal(gradient, same)
    shown = torch.where(hidden, photo, image)
    similar = plain_loss(shown, photo, 0.0)
    torch.testing.assert_close(photo_loss(image, photo, weights, 0.0), similar)  # over H W, not over the weights
    nothing, flat = photo_loss_and_gradient(image, photo, torch.zeros_like(weights))
    assert nothing == 0 and not flat.any()


def test_any_number_of_threads_gives_the_same_bits():
    image, photo = (t.float() for t in make_images(2, 45, 33))
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            found.append(photo_loss_and_gradient(image, photo))
    finally:
        torch.set_num_threads(threads)
    for loss, gradient in found[1:]:
        assert torch.equal(loss, found[0][0]) and torch.equal(gradient, found[0][1])


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(image=torch.zeros(4, 4, 3)), r"image must be \[V,H,W,3\] with at least one pixel, got \[4, 4, 3\]"),
        (dict(image=torch.zeros(0, 4, 4, 3)), "at least one pixel"),
        (dict(image=torch.zeros(1, 4, 4, 3, dtype=torch.float16)), "image must be float32 or float64 on cpu"),
        (dict(photo=torch.zeros(1, 4, 5, 3)), r"photo must be \[1, 4, 4, 3\], got \[1, 4, 5, 3\]"),
        (dict(photo=torch.zeros(1, 4, 4, 3).double()), "photo must be torch.float32 on cpu, got torch.float64 on cpu"),
        (dict(photo=None), "photo: expected torch.Tensor, got NoneType"),
        (dict(weights=torch.ones(1, 4, 4, 3)), r"weights must be \[1, 4, 4\]"),
        (dict(weights=torch.ones(1, 4, 4, dtype=torch.uint8)), "weights must be torch.float32"),
        (dict(ssim_lambda=1.5), "ssim_lambda must be 0..1, got 1.5"),
    ],
)
def test_what_cannot_be_used_is_said(change, message):
    given = dict(image=torch.zeros(1, 4, 4, 3), photo=torch.zeros(1, 4, 4, 3)) | change
    with pytest.raises(InputError, match=message):
        photo_loss_and_gradient(**given)
