"""Measures of images against closed forms."""

import math

import pytest
import torch

from lightfield_gs.reference.metrics import gradient_psnr_db


def test_gradients_of_a_ramp_that_is_too_steep_miss_by_its_slope():
    """A ramp of slope a in place of b: all differences along it are off by a - b, all across it by nothing."""
    rows, columns = 12, 20
    ramp = torch.arange(columns, dtype=torch.float64).expand(2, 3, rows, columns)
    slopes = torch.tensor([0.03, 0.01], dtype=torch.float64)[:, None, None, None]
    along, across = rows * (columns - 1), (rows - 1) * columns
    found = gradient_psnr_db(slopes * ramp, 0.005 * ramp)
    for value, error in zip(found.tolist(), (0.025, 0.005)):
        assert value == pytest.approx(-10 * math.log10(error**2 * along / (along + across)), abs=1e-9)


def test_brightness_costs_nothing_and_a_soft_edge_does():
    edge = torch.zeros(1, 3, 8, 9, dtype=torch.float64)
    edge[..., 4:] = 0.5
    assert gradient_psnr_db(edge + 0.25, edge) == 100
    soft = edge.clone()
    soft[..., 4] = 0.25  # the step of 0.5 becomes two of 0.25: two errors of 0.25 in each row
    expected = -10 * math.log10(8 * 2 * 0.25**2 / (8 * 8 + 7 * 9))
    assert float(gradient_psnr_db(soft, edge)) == pytest.approx(expected, abs=1e-9)
    assert gradient_psnr_db(edge.flip(-1), edge).shape == (1,)


def test_pixels_without_weight_are_in_no_gradient():
    """As if the picture ended before them; half of all weights change nothing."""
    generator = torch.Generator().manual_seed(0)
    images, wanted = torch.rand(2, 4, 3, 8, 9, generator=generator, dtype=torch.float64)
    weights = torch.full((4, 8, 9), 0.5, dtype=torch.float64)
    weights[..., 5:] = 0
    expected = gradient_psnr_db(images[..., :5], wanted[..., :5])
    torch.testing.assert_close(gradient_psnr_db(images, wanted, weights), expected)
