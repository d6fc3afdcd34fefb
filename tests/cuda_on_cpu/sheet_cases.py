"""What the native sheet over a photo is compared with PyTorch's on: the CPU's, a GPU's, or the CUDA stage compiled for
the CPU."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from lightfield_gs.base.harmonics import rotations
from lightfield_gs.models.detail import DetailLevel, SheetSurface, _sheet, upsample_along_surface
from lightfield_gs.models.initializer import describe_pixels, flat
from lightfield_gs.models.ramps import snap_ramps, upsample_covered
from lightfield_gs.models.sheet import lay_texels
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

OTHERS = 5  # Gaussians behind the texels, which are nobody's business here


class Case(NamedTuple):
    """Photos, height, width, factor, degree of the harmonics, width of a texel on the screen, focal length in widths.

    A focal length of a hundred makes a ramp of the step in the middle, which has to be snapped.
    """

    photos: int
    height: int
    width: int
    factor: int
    degree: int = 0
    texel_px: float = 4.5
    focal: float = 1.4


CASES = [
    Case(1, 24, 20, 1),
    Case(2, 12, 20, 2, 1),
    Case(1, 11, 70, 4),  # more than a block of threads in a row
    Case(1, 8, 6, 4, 3, 0.4),  # blur reaches beyond the photo
    Case(1, 1, 3, 2),
    Case(1, 20, 24, 1, 0, 4.5, 100.0),
    Case(2, 16, 20, 2, 0, 4.5, 100.0),
    Case(1, 10, 14, 4, 0, 4.5, 100.0),
]


def inputs(case: Case) -> tuple[SheetSurface, Tensor, Tensor, Tensor]:
    """A slanted wavy surface with an edge in the middle, its opacity, a photo, and its camera, in float64.

    The photo shows an object with a soft outline and haze round it.
    """
    random = torch.Generator().manual_seed(case.width)

    def draw(*shape: int) -> Tensor:
        return torch.rand(case.photos, *shape, generator=random, dtype=torch.float64)

    rows, columns = (torch.arange(size, dtype=torch.float64) + 0.5 for size in (case.height, case.width))
    disparity = 0.8 + 0.004 * rows[:, None] + 0.01 * torch.sin(columns) + 0.002 * draw(1, case.height, case.width)
    if case.focal < 10:
        disparity = disparity + 0.3 * (columns > case.width / 2)
    else:
        disparity = 0.8 + 1e-3 * (disparity - 0.8) + 0.1 * ((columns - case.width / 2) / 5 + 0.5).clamp(0, 1)
    size = case.factor * case.height, case.factor * case.width
    y, x = (torch.linspace(-1, 1, count, dtype=torch.float64) for count in size)
    alpha = (1.4 * (1.1 - torch.hypot(x, y[:, None])) + 0.3 * draw(1, *size)).clamp(0, 1)
    photo = torch.cat([draw(3, *size) * alpha, alpha], 1)
    mask = torch.nn.functional.avg_pool2d(alpha, case.factor)
    focal = [case.focal, 1.3 / 1.4 * case.focal, 0.45, 0.55]
    camera = torch.tensor([focal], dtype=torch.float64) * torch.tensor([case.width, case.height] * 2)
    harmonics = draw(3 * ((case.degree + 1) ** 2 - 1), case.height, case.width)
    return SheetSurface(disparity, harmonics), mask, photo, camera.expand(case.photos, 4)


def laid(case: Case, device: str = "cpu") -> dict[str, Tensor]:
    """The fields as the native stage writes them, before others that it must leave alone."""
    surface, *pictures, camera = inputs(case)
    mask, photo = (picture.float().to(device) for picture in pictures)
    count, harmonics = photo.shape[2] * photo.shape[3] + OTHERS, (case.degree + 1) ** 2
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, harmonics, 3))
    out = from_tensors(torch.full((case.photos, *shape), math.nan, device=device) for shape in shapes)
    surface = SheetSurface(*(channels.float().to(device) for channels in surface))
    level = DetailLevel(case.factor, case.texel_px)
    with torch.no_grad():
        lay_texels(surface, mask, photo, camera.float().to(device), level, out)
    return {name: field.cpu() for name, field in out.fields().items()}


def expected(case: Case) -> Gaussians:
    """PyTorch's in float64, of the same numbers in float32."""
    surface, mask, photo, camera = inputs(case)
    mask, photo, camera = (numbers.float().double() for numbers in (mask, photo, camera))
    disparity, harmonics = (channels.float().double() for channels in surface)
    harmonics = upsample_along_surface(harmonics, disparity, (1 / camera[:, 0])[:, None, None, None], case.factor)
    texels = describe_pixels(photo, case.factor * camera)
    fine = upsample_covered(disparity, mask, case.factor)
    snapped = snap_ramps(fine, texels.colour, texels.mask, texels.footprint, case.factor)
    assert case.focal < 10 or ((snapped - fine).abs() > 1e-3).any()
    *fields, constant = _sheet(snapped, texels, case.texel_px)
    return from_tensors([*fields, torch.cat([constant, flat(harmonics).unflatten(2, (-1, 3))], 2)])


def compare(case: Case, found: dict[str, Tensor]) -> None:
    """Assert that a stage's result is PyTorch's within float32.

    Slopes are differences of disparities between texels, divided by the texels' footprints.
    """
    right = expected(case)
    assert all(field[:, -OTHERS:].isnan().all() for field in found.values())
    mine = from_tensors(field[:, :-OTHERS].double() for field in found.values())
    torch.testing.assert_close(mine.means, right.means, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(mine.opacities, right.opacities, rtol=1e-5, atol=2e-6)
    torch.testing.assert_close(mine.sh, right.sh, rtol=1e-5, atol=3e-5)
    seen = right.opacities > 0
    assert 0.2 < seen.double().mean() and torch.equal(seen, mine.opacities > 0)
    torch.testing.assert_close(mine.quaternions.norm(dim=2), torch.ones_like(mine.opacities), rtol=0, atol=1e-6)
    sizes = right.scales.amax(2)[..., None, None]
    error = ((covariances(mine) - covariances(right)) / sizes.square())[seen].abs().amax((1, 2))
    slope = 1e-6 * case.factor * case.width * case.focal / 1.4
    # What is level across descends to the left or to the right by 1e-4, as rounding has it
    assert error.quantile(0.98) < slope and error.max() < slope + 3e-4, (case, error.max(), error.quantile(0.98))
    flat = mine.scales[~seen]  # beside the object: finite, as large as a texel
    assert ((flat > 0) & (flat < 2 * right.scales[~seen].amax(1, keepdim=True))).all()


def covariances(gaussians: Gaussians) -> Tensor:
    axes = rotations(gaussians.quaternions) * gaussians.scales[..., None, :]
    return axes @ axes.transpose(-1, -2)
