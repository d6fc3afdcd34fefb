"""Ramps of depth: what snapping does to steps, slopes and thin things that are known."""

import math

import pytest
import torch
from torch.nn.functional import interpolate

from lightfield_gs.models.ramps import snap_ramps, upsample_covered

SIZE, FOCAL = 24, 358.0  # pixels of the network's grid, as of a crop from a photo of 256 pixels
NEAR, FAR, EDGE = 1.1, 1.4, 12  # depths, and the column where the near surface ends
COLUMNS = torch.arange(SIZE, dtype=torch.float64) + 0.5


def texels(disparity: torch.Tensor, factor: int, edge: float | None = EDGE) -> tuple[torch.Tensor, ...]:
    """Return disparities [1,1,H,W], colours and opacities of the texels over a row [SIZE] of disparities.

    The photo is red left of the edge, blue right of it, and a little noisy.
    """
    random = torch.Generator().manual_seed(0)
    fine = upsample_covered(disparity.expand(1, 1, SIZE, SIZE), torch.ones(1, 1, SIZE, SIZE), factor)
    columns = (torch.arange(factor * SIZE, dtype=torch.float64) + 0.5) / factor
    blue = (columns > (EDGE if edge is None else edge)).double()
    colour = torch.stack([1 - blue, 0 * blue, blue], 0)[None, :, None].expand(1, 3, factor * SIZE, -1)
    noise = 0.02 * torch.rand(1, 3, factor * SIZE, factor * SIZE, generator=random, dtype=torch.float64)
    return fine, colour + noise, torch.ones_like(fine)


def footprint(factor: int) -> torch.Tensor:
    return torch.full((1, 1, 1, 1), 1 / (factor * FOCAL), dtype=torch.float64)


def snapped(disparity: torch.Tensor, factor: int) -> torch.Tensor:
    fine, colour, mask = texels(disparity, factor)
    return snap_ramps(fine, colour, mask, footprint(factor), factor)


def step(ramp_px: float, off_px: float = 0.0) -> torch.Tensor:
    """Return disparities [SIZE] of a near surface on the left, which over some pixels goes down to a far one."""
    part = ((COLUMNS - EDGE - off_px) / ramp_px + 0.5).clamp(0, 1)
    return (1 - part) / NEAR + part / FAR


@pytest.mark.parametrize("factor", [1, 2, 4])
@pytest.mark.parametrize("off_px", [-1.0, 0.0, 0.7])
def test_no_texel_is_in_the_gap_that_opens_behind_a_near_surface(factor, off_px):
    """From 15 degrees to the right, the near surface has left a gap beside the far one. It ends at the photo's edge."""
    places = (torch.arange(factor * SIZE, dtype=torch.float64) + 0.5) / factor

    def seen_at(disparity: torch.Tensor) -> torch.Tensor:
        """Return the columns, in pixels, at which a camera sees the texels that has moved about depth NEAR."""
        return places - FOCAL * NEAR * math.tan(math.radians(15)) * (disparity - 1 / NEAR)

    gap = EDGE + 1, EDGE - FOCAL * NEAR * math.tan(math.radians(15)) * (1 / FAR - 1 / NEAR) - 1
    assert gap[1] - gap[0] > 10
    before = seen_at(texels(step(4, off_px), factor)[0])
    found = snapped(step(4, off_px), factor)
    after = seen_at(found)
    assert ((before > gap[0]) & (before < gap[1])).any(3).all()
    assert not ((after > gap[0]) & (after < gap[1])).any()
    right = torch.where(places < EDGE, 1 / NEAR, 1 / FAR).expand_as(found)
    assert ((found - right).abs() < 1e-3).double().mean() > 0.98


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_slopes_and_thin_things_stay(factor):
    """A floor at 80 degrees descends by 6 footprints a pixel; a bar of two pixels has no ramp on both sides."""
    floor = 1 / (1.1 * torch.exp(6 * (COLUMNS - EDGE) / FOCAL))
    bar = torch.where((COLUMNS - EDGE).abs() < 1, 1 / NEAR, 1 / FAR).double()
    for disparity in (floor, bar) if factor == 1 else (floor,):
        fine = texels(disparity, factor)[0]
        torch.testing.assert_close(snapped(disparity, factor), fine, rtol=1e-12, atol=0)


def test_what_is_beside_the_object_does_not_leak_into_it():
    disparity = torch.where(COLUMNS < EDGE, 0.9, 50.0).double().expand(1, 1, SIZE, SIZE)
    mask = (COLUMNS < EDGE).double().expand(1, 1, SIZE, SIZE)
    fine = upsample_covered(disparity, mask, 4)
    assert (fine[..., : 4 * EDGE] - 0.9).abs().max() < 0.05
    plain = interpolate(disparity, scale_factor=4, mode="bilinear")
    torch.testing.assert_close(upsample_covered(disparity, torch.ones_like(mask), 4), plain)


def test_photos_of_a_batch_are_snapped_alone():
    one, other = (texels(step(4, off), 2) for off in (0.0, 1.0))
    both = snap_ramps(*(torch.cat(pair) for pair in zip(one, other)), footprint(2), 2)
    alone = [snap_ramps(*photo, footprint(2), 2) for photo in (one, other)]
    torch.testing.assert_close(both, torch.cat(alone), rtol=0, atol=0)


def test_gradients():
    random = torch.Generator().manual_seed(1)
    fine, colour, mask = texels(step(4), 2)
    fine = fine * (1 + 1e-3 * torch.rand(fine.shape, generator=random, dtype=torch.float64))
    around = 2 * EDGE - 6

    def outputs(part: torch.Tensor) -> torch.Tensor:
        whole = torch.cat([fine[:, :, :20], part, fine[:, :, 24:]], 2)
        return snap_ramps(whole, colour, mask, footprint(2), 2)[:, :, 20:24, around : around + 12]

    rows = fine[:, :, 20:24].clone().requires_grad_()
    assert (outputs(rows) - rows[..., around : around + 12]).abs().max() > 1e-3
    assert torch.autograd.gradcheck(outputs, (rows,), eps=1e-8, atol=1e-4)
