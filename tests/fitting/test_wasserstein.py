"""WD-R against its definition in plain loops, and in `fit`; with random networks, since VGG-16's weights are large."""

import urllib.error

import numpy as np
import pytest
import torch
from fit_capture import write_capture

import lightfield_gs as lf
from lightfield_gs import InputError
from lightfield_gs.fitting import vgg16
from lightfield_gs.fitting.photo_loss import photo_loss_and_gradient
from lightfield_gs.fitting.wasserstein import DISTORTION_WEIGHT, LOG2_SIGMA, PIXEL_WEIGHT, SCALES, WassersteinLoss

QUICK = dict(steps=3, cap_max=100, device="cpu", progress=False, test_every=8, loss="wd")


def network(dtype=torch.float64):
    """Blocks of two and one convolutions, of 5 and 4 channels."""
    generator = torch.Generator().manual_seed(3)
    blocks, channels = [], 3
    for widths in ((5, 5), (4,)):
        block = []
        for width in widths:
            weight = torch.randn(width, channels, 3, 3, generator=generator, dtype=dtype) / (3 * channels**0.5)
            block.append(vgg16.Convolution(weight, torch.randn(width, generator=generator, dtype=dtype) / 4))
            channels = width
        blocks.append(tuple(block))
    return tuple(blocks)


def images(height, width, count=2):
    generator = torch.Generator().manual_seed(1)
    image, photo = torch.rand(2, count, height, width, 3, generator=generator, dtype=torch.float64)
    return image, photo, torch.rand(count, height, width, generator=generator)


# --- The definition


def smooth(array, stride):
    """[1 2 1] / 4 in both directions of [C,H,W], zeros outside."""
    channels, height, width = array.shape
    found = np.zeros((channels, -(-height // stride), -(-width // stride)))
    for y in range(found.shape[1]):
        for x in range(found.shape[2]):
            for v in (-1, 0, 1):
                for u in (-1, 0, 1):
                    row, column = y * stride + v, x * stride + u
                    if 0 <= row < height and 0 <= column < width:
                        found[:, y, x] += (2 - abs(v)) * (2 - abs(u)) / 16 * array[:, row, column]
    return found


def convolve(array, weight, bias):
    channels, height, width = array.shape
    found = np.zeros((len(weight), height, width)) + bias[:, None, None]
    for y in range(height):
        for x in range(width):
            for v in range(max(0, y - 1), min(height, y + 2)):
                for u in range(max(0, x - 1), min(width, x + 2)):
                    found[:, y, x] += weight[:, :, v - y + 1, u - x + 1] @ array[:, v, u]
    return np.maximum(found, 0)


def arrays(image, blocks):
    """The features of an image [H,W,3], with the base-two logarithm of sigma in their own pixels."""
    current = (image.transpose(2, 0, 1) - np.array([[[0.485]], [[0.456]], [[0.406]]])) / np.array(
        [[[0.229]], [[0.224]], [[0.225]]]
    )
    yield current, LOG2_SIGMA
    for scale in range(SCALES):
        array = current
        for place, block in enumerate(blocks):
            if place:
                height, width = array.shape[1] // 2, array.shape[2] // 2
                array = array[:, : 2 * height, : 2 * width].reshape(-1, height, 2, width, 2).mean((2, 4))
            for weight, bias in block:
                array = convolve(array, weight.numpy(), bias.numpy())
            yield array, max(0, LOG2_SIGMA - scale - place)
        current = smooth(current, 2)


def distortion(image, photo, blocks):
    total = 0.0
    for (array, level), (other, _) in zip(arrays(image, blocks), arrays(photo, blocks)):
        if level == 0:
            total += np.square(array - other).mean()
            continue
        moments = []
        for features in (array, other):
            mean, square = features, features**2
            for stride in (*[2] * (level - 1), 1):
                mean, square = smooth(mean, stride), smooth(square, stride)
            moments.append((mean, np.sqrt(square - mean**2 + 1e-6)))
        total += sum(np.square(one - two).mean() for one, two in zip(*moments))
    return total


def test_the_distortion_is_its_definition():
    image, photo, weights = images(17, 12)
    blocks = network()
    seen = photo + weights[..., None].double() * (image - photo)
    for given, masks in ((image, None), (seen, weights)):
        expected = sum(distortion(one.numpy(), two.numpy(), blocks) for one, two in zip(given, photo))
        assert float(WassersteinLoss(blocks).distortion(image, photo, masks)) == pytest.approx(expected, rel=1e-9)


def test_gradients():
    image, photo, weights = images(5, 4, 1)
    loss = WassersteinLoss(network())
    image.requires_grad_()
    assert torch.autograd.gradcheck(lambda given: loss.distortion(given, photo, weights), image)
    value, gradient = loss(image, photo, weights)
    pixels, pixel_gradient = photo_loss_and_gradient(image, photo, weights)
    texture = loss.distortion(image, photo, weights)
    assert float(value) == pytest.approx(float(PIXEL_WEIGHT * pixels + DISTORTION_WEIGHT * texture.detach()))
    expected = PIXEL_WEIGHT * pixel_gradient + DISTORTION_WEIGHT * torch.autograd.grad(texture, image)[0]
    torch.testing.assert_close(gradient, expected)


def test_texture_may_move_but_not_go():
    _, photo, _ = images(32, 48, 1)
    loss, flat = WassersteinLoss(network()), photo.mean((1, 2), keepdim=True).expand_as(photo)
    moved = photo.roll((1, 2), (1, 2))
    assert float(loss.distortion(photo, photo)) == 0
    assert (photo - flat).abs().mean() < (photo - moved).abs().mean()
    assert loss.distortion(flat, photo) > 4 * loss.distortion(moved, photo)


def test_pixels_without_weight_change_nothing():
    image, photo, weights = images(16, 16, 1)
    weights[:, 4:9] = 0
    loss = WassersteinLoss(network())
    value, gradient = loss(image, photo, weights)
    assert not gradient[:, 4:9].any() and gradient[:, :4].all()
    image[:, 4:9] = 7.0
    assert loss(image, photo, weights)[0] == value


# --- In fits


@pytest.fixture
def weights_file(tmp_path, monkeypatch):
    """The path of VGG-16's weights in a folder of their own, where there are none yet."""
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    path = vgg16.WEIGHTS.path
    path.parent.mkdir(parents=True)
    return path


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return write_capture(tmp_path_factory.mktemp("fit") / "capture", masked=True)


def random_weights():
    """Tensors of VGG-16's convolutions as torchvision names them, in half precision."""
    generator, tensors, channels = torch.Generator().manual_seed(2), {}, 3
    for number, width in zip(
        (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28), [64] * 2 + [128] * 2 + [256] * 3 + [512] * 6
    ):
        weight = torch.randn(width, channels, 3, 3, generator=generator) * (2 / (9 * channels)) ** 0.5
        tensors |= {f"features.{number}.weight": weight.half(), f"features.{number}.bias": torch.zeros(width).half()}
        channels = width
    return tensors


def test_a_fit_by_it_goes_on_by_it(capture, tmp_path, weights_file, capsys):
    torch.save(random_weights(), weights_file)
    folder = tmp_path / "run"
    lf.fit(capture, **QUICK, folder=folder, stop=lambda: True)
    with pytest.raises(InputError, match="loss was 'wd' and is 'l1-ssim'"):
        lf.fit(capture, **{**QUICK, "loss": "l1-ssim"}, folder=folder)
    seen, watch = [], dict(callback=lambda state: seen.append(state.gaussians.means), callback_every=1)
    stopped, whole = lf.fit(capture, **QUICK, folder=folder), lf.fit(capture, **{**QUICK, "progress": True}, **watch)
    lf.fit(capture, **{**QUICK, "loss": "l1-ssim"}, **watch)
    steps = [torch.equal(one, other) for one, other in zip(seen[:3], seen[3:])]
    assert len(seen) == 6 and steps == [True, True, False]  # texture counts in the second half
    assert torch.equal(stopped.gaussians.means, whole.gaussians.means) and whole.settings.loss == "wd"
    assert "loss: WD-R" in capsys.readouterr().out


def test_missing_and_foreign_weights_are_refused(capture, weights_file, monkeypatch):
    def offline(*_, **__):
        raise urllib.error.URLError("no route to host")

    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    with pytest.raises(
        InputError, match=f"no route to host.*save {vgg16.WEIGHTS.url} in the folder {weights_file.parent}"
    ):
        lf.fit(capture, **QUICK)
    torch.save({"features.0.weight": torch.zeros(64, 3, 3, 3)}, weights_file)
    with pytest.raises(InputError, match=r"expected a tensor features.0.bias \[64\] of VGG-16, got none"):
        lf.fit(capture, **QUICK)
