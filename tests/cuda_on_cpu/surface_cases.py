"""What the native surface of a photo's sheet is compared with PyTorch's on: the CPU's, a GPU's, or the CUDA stage
compiled for the CPU."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lightfield_gs.models.composer import DeltaComposer, parameter_groups
from lightfield_gs.models.config import ModelConfig
from lightfield_gs.models.detail import SheetSurface, sheet_surface
from lightfield_gs.models.initializer import describe_pixels
from lightfield_gs.models.sheet import find_surface
from lightfield_gs.scene.gaussians import Gaussians


class Case(NamedTuple):
    """Photos, side of the network's grid, layers, degree of the harmonics."""

    photos: int
    size: int
    layers: int
    degree: int


CASES = [Case(1, 32, 2, 0), Case(2, 16, 3, 1), Case(1, 8, 1, 2)]


def inputs(case: Case) -> tuple[Gaussians, Tensor, Tensor]:
    """A cloud as networks predict it, pictures of a disc, and their cameras, float32."""
    random = torch.Generator().manual_seed(case.size)
    config = ModelConfig(image_size_px=case.size, layers=case.layers, sh_degree=case.degree)
    channels = case.layers * sum(parameter_groups(case.degree).values())
    raw = 0.3 * torch.randn(case.photos, channels, case.size, case.size, generator=random)
    places = torch.linspace(-1, 1, case.size)
    alpha = (3 * (0.9 - torch.hypot(places, places[:, None]))).clamp(0, 1).expand(case.photos, 1, -1, -1)
    images = torch.cat([alpha * torch.rand(case.photos, 3, case.size, case.size, generator=random), alpha], 1)
    camera = torch.tensor([[1.4, 1.4, 0.5, 0.45]]).expand(case.photos, 4) * case.size
    return DeltaComposer(config)(raw, describe_pixels(images, camera)), images, camera


@torch.no_grad()
def found(case: Case, device: str = "cpu") -> dict[str, Tensor]:
    cloud, images, camera = inputs(case)
    cloud = cloud.mapped(lambda field: field.to(device).contiguous())
    surface = find_surface(cloud, images[:, 3:].to(device), camera.to(device), case.layers)
    return {name: part.cpu() for name, part in (surface._asdict() | cloud.fields()).items()}


@torch.no_grad()
def expected(case: Case) -> tuple[SheetSurface, Gaussians]:
    """PyTorch's in float64, of the same numbers."""
    cloud, images, camera = inputs(case)
    pixels = describe_pixels(images.double(), camera.double())
    return sheet_surface(cloud.to(torch.float64), pixels, case.layers)


def compare(case: Case, have: dict[str, Tensor]) -> None:
    """Asserts that both are the same, as far as float32 goes."""
    surface, faded = expected(case)
    for name, right in (surface._asdict() | faded.fields()).items():
        torch.testing.assert_close(have[name].double(), right, rtol=2e-4, atol=2e-4)
    assert (have["opacities"] < 0.9 * inputs(case)[0].opacities).double().mean() > 0.1  # something fades
