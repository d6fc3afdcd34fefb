"""The terms of the loss, and the scores that they are measured by."""

import math

import numpy as np
import pytest
import torch

from lightfield_gs.reference.metrics import gradient_psnr_db, psnr_db, ssim
from training.losses import LossWeights, composite, gradient_error, outline_error, roughness, total_loss, translucency


def test_psnr_of_a_constant_error():
    image = torch.rand(2, 3, 8, 8)
    torch.testing.assert_close(psnr_db(image, image + 0.1), torch.full((2,), 20.0), atol=1e-3, rtol=0)
    assert psnr_db(image, image).tolist() == [100, 100]


def test_ssim_is_the_published_formula():
    """Against sums written out pixel by pixel in float64."""
    rng = np.random.default_rng(0)
    x, y = rng.random((3, 13, 17)), rng.random((3, 13, 17))
    taps = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    window = np.outer(taps, taps) / taps.sum() ** 2
    padded = [np.pad(a, ((0, 0), (5, 5), (5, 5))) for a in (x, y)]
    total = []
    for c, i, j in np.ndindex(x.shape):
        a, b = (p[c, i : i + 11, j : j + 11] for p in padded)
        mean_a, mean_b = (window * a).sum(), (window * b).sum()
        var_a, var_b = (window * a * a).sum() - mean_a**2, (window * b * b).sum() - mean_b**2
        covariance = (window * a * b).sum() - mean_a * mean_b
        total.append(
            (2 * mean_a * mean_b + 1e-4)
            * (2 * covariance + 9e-4)
            / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))
        )
    assert float(ssim(torch.from_numpy(x), torch.from_numpy(y))) == pytest.approx(np.mean(total), abs=1e-12)
    assert float(ssim(torch.from_numpy(x).float(), torch.from_numpy(x).float())) == pytest.approx(1, abs=1e-5)


def test_loss_is_the_weighted_sum_of_its_terms():
    targets, backgrounds = torch.rand(2, 3, 4, 16, 16), torch.rand(2, 3, 3)
    targets[:, :, :3] *= targets[:, :, 3:]
    wanted = composite(targets, backgrounds)
    expected = targets[0, 1, :3, 4, 5] + (1 - targets[0, 1, 3, 4, 5]) * backgrounds[0, 1]
    torch.testing.assert_close(wanted[0, 1, :, 4, 5], expected)
    scene = torch.ones(2, 16 * 16, 3), torch.rand(2, 4, 16, 16)
    zero, _ = total_loss(wanted, targets[:, :, 3], targets, backgrounds, *scene, LossWeights())
    assert float(zero) == pytest.approx(0, abs=1e-5)
    weights = LossWeights(2.0, ssim=0.5, alpha=3.0)
    total, terms = total_loss(wanted + 0.1, targets[:, :, 3] - 0.2, targets, backgrounds, *scene, weights)
    assert float(terms["colour"]) == pytest.approx(0.01, abs=1e-6)
    assert float(terms["alpha"]) == pytest.approx(0.04, abs=1e-6)
    assert float(total) == pytest.approx(2 * 0.01 + 0.5 * float(terms["ssim"]) + 3 * 0.04, abs=1e-6)


def test_outline_error_leaves_a_band_along_the_outline_out():
    """Of 512 px: 2 px inside the square and 4 px outside it."""
    truth, alpha = torch.zeros(1, 1, 512, 512), torch.zeros(1, 1, 512, 512)
    truth[..., 100:200, 100:300] = 1
    assert float(outline_error(alpha, truth)) * 512**2 == pytest.approx(96 * 196, rel=1e-5)
    alpha[..., 50, 50], alpha[..., 97, 150], alpha[..., 95, 150] = 0.25, 1, 0.5
    assert float(outline_error(alpha, truth)) * 512**2 == pytest.approx(96 * 196 + 0.75, rel=1e-5)


def test_the_logarithm_of_errors_is_that_of_each_image():
    targets, backgrounds = torch.zeros(2, 1, 4, 16, 16), torch.zeros(2, 1, 3)
    images = torch.tensor([0.1, 0.3]).view(2, 1, 1, 1, 1).expand(2, 1, 3, 16, 16)
    scene = torch.ones(2, 16 * 16, 3), torch.zeros(2, 4, 16, 16)
    weights = LossWeights(colour=0, log_colour=0.5, ssim=0, alpha=0)
    total, _ = total_loss(images, targets[:, :, 3], targets, backgrounds, *scene, weights)
    assert float(total) == pytest.approx(0.5 * (math.log(0.01 + 1e-4) + math.log(0.09 + 1e-4)) / 2, rel=1e-5)


def test_the_gradient_term_is_what_sharpness_is_scored_by():
    images, wanted = torch.rand(2, 3, 4, 20, 20)[:, :, :3].unbind(0)
    scores = gradient_psnr_db(images, wanted)
    assert float(gradient_error(images, wanted)) == pytest.approx(float((10 ** (-scores / 10)).mean()), rel=1e-5)
    scene = torch.ones(1, 256, 3), torch.zeros(1, 4, 16, 16)
    targets, backgrounds = torch.zeros(1, 2, 4, 16, 16), torch.zeros(1, 2, 3)
    alternating = (torch.arange(16) % 2).float().expand(1, 2, 3, 16, 16)  # all differences along rows are 1
    weights = LossWeights(colour=0, ssim=0, alpha=0, gradient=3)
    total, terms = total_loss(alternating, targets[:, :, 3], targets, backgrounds, *scene, weights)
    assert float(terms["gradient"]) == pytest.approx(0.5) and float(total) == pytest.approx(1.5)
    flat, _ = total_loss(0 * alternating + 0.4, targets[:, :, 3], targets, backgrounds, *scene, weights)
    assert float(flat) == 0


def test_translucency_turns_doubt_about_an_outline_into_a_decision():
    chance = torch.tensor(0.7)  # that the pixel is object
    opacities = torch.linspace(0, 1, 1001)
    errors = chance * (1 - opacities).square() + (1 - chance) * opacities.square()
    for weight, best in ((0.0, 0.7), (0.25, 0.766666), (0.5, 0.9), (0.8, 1.0), (2.0, 1.0)):
        costs = errors + weight * torch.stack([translucency(alpha) for alpha in opacities])
        assert float(opacities[costs.argmin()]) == pytest.approx(best, abs=1.5e-3)  # where its derivative is zero
    scene = torch.ones(1, 256, 3), torch.zeros(1, 4, 16, 16)
    alpha, targets = torch.full((1, 2, 16, 16), 0.25), torch.zeros(1, 2, 4, 16, 16)
    images, backgrounds = torch.zeros(1, 2, 3, 16, 16), torch.zeros(1, 2, 3)
    total, terms = total_loss(images, alpha, targets, backgrounds, *scene, LossWeights(ssim=0, alpha=0, translucency=2))
    assert float(terms["translucency"]) == pytest.approx(0.1875) and float(total) == pytest.approx(0.375)


def test_roughness_counts_steps_of_disparity_on_the_object():
    disparity = torch.full((2, 6, 8), 0.8)  # two layers of 6 x 8 pixels
    disparity[0, :, 4:] = 0.9
    means = torch.zeros(1, 96, 3)
    means[0, :, 2] = 1 / disparity.flatten()
    grey = torch.full((1, 4, 6, 8), 0.5)
    grey[:, 3] = 1
    # One step of 0.1 in each of 6 rows of one layer, among 2 x 6 x 7 pairs along rows; none along columns.
    assert float(roughness(means, grey)) == pytest.approx(6 * 0.1 / (2 * 6 * 7), rel=1e-4)
    grey[0, 3, :, 4] = 0  # the step lies outside the object
    assert float(roughness(means, grey)) == pytest.approx(0, abs=1e-6)
    grey[0, 3], grey[0, :3, :, 4:] = 1, 0.8  # the step lies on an edge of the picture
    assert float(roughness(means, grey)) == pytest.approx(6 * 0.1 * math.exp(-3) / (2 * 6 * 7), rel=1e-3)
