"""Depth maps that are brought to the size of their photo."""

import torch
from torch.nn.functional import avg_pool2d, interpolate

from lightfield_gs.photo.joint_upsampling import upsample

HEIGHT, WIDTH = 240, 320


def ball_before_a_slope() -> tuple[torch.Tensor, torch.Tensor]:
    """Disparities [H, W] of a disc before a slope, and a noisy photo [H, W, 3] of two colours."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    disc = (x - 140).square() + (y - 120).square() < 70**2
    colours = torch.where(disc[..., None], torch.tensor([0.7, 0.5, 0.4]), torch.tensor([0.3, 0.45, 0.5]))
    noise = 0.03 * torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(0))
    return torch.where(disc, 1.0, 0.2 * y / HEIGHT), (colours + noise).clamp(0, 1)


def soft_and_small(disparities: torch.Tensor) -> torch.Tensor:
    small = interpolate(disparities[None, None], scale_factor=0.25, mode="area")
    return avg_pool2d(small, 3, 1, 1, count_include_pad=False)[0, 0]


def test_edges_go_where_the_photo_has_them_and_slopes_stay():
    disparities, photo = ball_before_a_slope()
    small = soft_and_small(disparities)
    found = upsample(small, photo, 1.0)
    bilinear = interpolate(small[None, None], size=(HEIGHT, WIDTH), mode="bilinear")[0, 0]
    wrong = [float(((values - disparities).abs() > 0.1).double().mean()) for values in (found, bilinear)]
    assert wrong[1] > 0.02 and wrong[0] < wrong[1] / 8
    # Nothing hangs between near and far
    assert float(((found > 0.4) & (found < 0.9)).double().mean()) < 0.0005
    slope = disparities < 0.5
    assert float((found - disparities)[slope].abs().median()) < 0.002


def test_a_photo_of_one_colour_keeps_the_map_within_its_range_and_without_edges_it_is_bilinear():
    small = soft_and_small(ball_before_a_slope()[0])
    found = upsample(small, torch.full((HEIGHT, WIDTH, 3), 0.5), 1.0)
    assert found.min() >= small.min() and found.max() <= small.max()
    flat = torch.linspace(0, 1, 200).expand(10, 200)
    bilinear = interpolate(flat[None, None], size=(20, 390), mode="bilinear")[0, 0]
    assert torch.equal(upsample(flat, torch.rand(20, 390, 3), 1.0), bilinear)
