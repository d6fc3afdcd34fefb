"""The photo laid over the network's Gaussians: against pictures, planes and steps that are known."""

import math

import pytest
import torch
from photo_cases import PANEL, photo, tiny_net

from lightfield_gs import Cameras, Gaussians, InputError, Panel, PhotoEncoder, render
from lightfield_gs.base.harmonics import SH_CONSTANT, rotations
from lightfield_gs.models import ModelConfig
from lightfield_gs.models.detail import upsample_along_surface, visible_surface, with_detail
from lightfield_gs.models.initializer import describe_pixels
from lightfield_gs.photo.detail_level import count, detail_level

SIZE = 32
INTRINSICS = torch.tensor([[45.0, 45.0, 16.0, 16.0]], dtype=torch.float64)


def picture(size: int) -> torch.Tensor:
    """Premultiplied RGBA [1,4,size,size], float64: waves that take 8 pixels of the network, on a disc."""
    grid = (torch.arange(size, dtype=torch.float64) + 0.5) / size
    y, x = torch.meshgrid(grid, grid, indexing="ij")
    waves = torch.stack(
        [0.5 + 0.3 * torch.sin(25 * x), 0.5 + 0.3 * torch.cos(25 * y), 0.5 + 0.2 * torch.sin(25 * x + y)]
    )
    alpha = ((0.4 - torch.hypot(x - 0.5, y - 0.5)) * size + 0.5).clamp(0, 1)
    return torch.cat([waves * alpha, alpha[None]])[None]


def cloud(depth: torch.Tensor, degree: int = 0, layers: int = 2, opacity: float = 0.5) -> Gaussians:
    """Return Gaussians of layers one footprint in front of and behind surfaces at depth [SIZE,SIZE].

    Their colours are the picture's at the network's resolution.
    """
    pixels = describe_pixels(picture(SIZE), INTRINSICS)
    parts = []
    for layer in range(layers):
        z = (depth * (1 + (2 * layer - 1) * pixels.footprint[0, 0])).flatten()
        means = torch.cat([pixels.rays[0].flatten(1).T * z[:, None], z[:, None]], 1)
        turn = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(len(z), 4)
        scales = (pixels.footprint[0, 0] * z[:, None]).expand(-1, 3)
        opacities = (opacity * pixels.mask[0, 0].flatten()).clamp(0, 1)
        sh = torch.zeros(len(z), (degree + 1) ** 2, 3, dtype=torch.float64)
        sh[:, 0] = (pixels.colour[0].flatten(1).T - 0.5) / SH_CONSTANT
        sh[:, 1:] = 0.1
        parts.append((means, turn, scales, opacities, sh))
    return Gaussians(*(torch.cat(field)[None] for field in zip(*parts)))


def slanted() -> torch.Tensor:
    """Depths [SIZE,SIZE] of the plane 1/z = 0.8 + 0.4 x/z."""
    pixels = describe_pixels(picture(SIZE), INTRINSICS)
    return 1 / (0.8 + 0.4 * pixels.rays[0, 0])


def detailed(depth: torch.Tensor, factor: int, degree: int = 0, opacity: float = 0.5) -> Gaussians:
    images, fine = picture(SIZE), picture(factor * SIZE)
    texels = describe_pixels(fine, factor * INTRINSICS)
    base = cloud(depth, degree, opacity=opacity)
    return with_detail(base, describe_pixels(images, INTRINSICS), texels, 2, factor)


def drawn(gaussians: Gaussians, factor: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours [3,factor*SIZE,factor*SIZE] that the photo's camera sees, and how opaque they are."""
    camera, size = factor * INTRINSICS, factor * SIZE
    cameras = Cameras(torch.eye(4, dtype=torch.float64)[None], camera[:, :2], camera[:, 2:], size, size)
    single = Gaussians(*(field[0] for field in gaussians.fields().values()))
    image, alpha, *_ = render(single, cameras, background=(0.0, 0.0, 0.0), alpha=True)
    return image[0].permute(2, 0, 1) / alpha.clamp_min(1e-9), alpha[0]


@pytest.mark.parametrize("factor, most", [(1, 0.05), (2, 0.025), (4, 0.025)])
def test_a_plane_shows_the_picture_that_is_on_it(factor, most):
    """The cloud says where it is, and is too thin to be seen. What of the sheet's opacity is left, 1 - exp(-1.8)."""
    truth = picture(factor * SIZE)[0]
    inside = -torch.nn.functional.max_pool2d(-truth[3:], 7, 1, 3)[0] == 1
    colour, alpha = drawn(detailed(slanted(), factor, opacity=0.01), factor)
    error = (colour - truth[:3])[:, inside]
    assert error.square().mean().sqrt() < most and error.mean().abs() < 0.01
    assert 0.75 < alpha[inside].min() and alpha[inside].max() < 0.95


def test_texels_lie_on_the_plane_and_along_it():
    depth, factor = slanted(), 4
    sheet = detailed(depth, factor).means[0, : (factor * SIZE) ** 2]
    x, _, z = sheet.unbind(1)
    inside = picture(factor * SIZE)[0, 3].flatten() == 1
    off = 1 / z - (0.8 + 0.4 * x / z)
    assert off[inside].abs().max() < 1.6 * 0.8 / 45  # the cloud lies a footprint before the plane and behind it
    normals = rotations(detailed(depth, factor).quaternions[0, : len(x)])[:, :, 2]
    # 1 = 0.8 z + 0.4 x
    expected = torch.tensor([0.4, 0, 0.8], dtype=torch.float64) / 0.8**0.5
    middle = inside & (x.abs() < 0.1)
    assert (
        (normals[middle] @ expected).abs() * (0.8**0.5) / torch.hypot(*torch.tensor([0.4, 0.8]).double())
    ).min() > 0.98


def test_nothing_is_interpolated_across_an_edge():
    disparity = torch.full((1, 1, 8, 8), 0.5, dtype=torch.float64)
    disparity[..., 4:] = 1.0
    fine = upsample_along_surface(disparity, disparity, torch.full((1, 1, 1, 1), 0.02, dtype=torch.float64), 4)
    assert fine.shape == (1, 1, 32, 32)
    assert (fine[..., :16] == 0.5).all() and (fine[..., 16:] == 1.0).all()


def test_a_slope_is_interpolated():
    columns = (torch.arange(8, dtype=torch.float64) + 0.5).expand(1, 1, 8, 8)
    fine = upsample_along_surface(columns, 1 + 0.01 * columns, torch.full((1, 1, 1, 1), 0.02, dtype=torch.float64), 4)
    expected = ((torch.arange(32, dtype=torch.float64) + 0.5) / 4).clamp(0.5, 7.5)
    torch.testing.assert_close(fine, expected.expand_as(fine))


def test_the_surface_is_where_the_cloud_is_seen():
    """Of a thin film and what is behind it each shows by what the film covers: 1 - exp(-its optical depth)."""
    pixels = describe_pixels(picture(SIZE), INTRINSICS)
    seen = 1 / visible_surface(cloud(torch.full((SIZE, SIZE), 1.2).double()), pixels, 2)[0][0, 0, 16, 16]
    film = 1.2 * (1 - pixels.footprint.item()), 1.2 * (1 + pixels.footprint.item())
    assert film[0] < seen < sum(film) / 2


def test_harmonics_are_those_of_the_cloud():
    sheet = detailed(slanted(), 2, degree=1).sh[0, : (2 * SIZE) ** 2]
    torch.testing.assert_close(sheet[:, 1:], torch.full_like(sheet[:, 1:], 0.1))


def test_texels_without_a_photo_are_not_seen():
    gaussians = detailed(slanted(), 2)
    empty = picture(2 * SIZE)[0, 3].flatten() == 0
    assert (gaussians.opacities[0, : len(empty)][empty] == 0).all()


def test_gradients():
    factor, depth = 2, slanted()
    base, images, fine = cloud(depth, 1), picture(SIZE), picture(factor * SIZE)
    rows = slice(15, 17)

    def outputs(means, opacities):
        changed = Gaussians(means, base.quaternions, base.scales, opacities, base.sh)
        texels = describe_pixels(fine, factor * INTRINSICS)
        found = with_detail(changed, describe_pixels(images, INTRINSICS), texels, 2, factor)
        return [field[0].unflatten(0, (-1, factor * SIZE))[rows, 30:34] for field in found.fields().values()]

    means, opacities = base.means.clone().requires_grad_(), (0.9 * base.opacities + 0.02).requires_grad_()
    assert torch.autograd.gradcheck(outputs, (means, opacities), fast_mode=True, atol=1e-4)


def test_auto_is_what_panel_and_photo_resolve_within_the_budget():
    config = ModelConfig(image_size_px=256)
    eight_k = Panel(width_px=7680, height_px=4320, views=96, line_number=9.8, slant_tan=1 / 6, phase=0.0, cone_deg=40.0)
    assert detail_level("auto", config, 4000, eight_k).factor == 4
    assert detail_level("auto", config, 500, eight_k).factor == 2
    assert detail_level("auto", config, 4000, eight_k, count(config, 4) - 1).factor == 2
    assert detail_level("auto", config, 4000, eight_k, 1000) is None
    assert detail_level(None, config, 4000, eight_k) is None
    small = Panel(width_px=800, height_px=480, views=24, line_number=9.8, slant_tan=1 / 6, phase=0.0, cone_deg=40.0)
    assert detail_level("auto", config, 4000, small).factor == 1


@pytest.mark.parametrize(
    "options", [dict(detail=3), dict(detail=True), dict(detail="auto", budget=0), dict(detail=[1])]
)
def test_refuses(options):
    with pytest.raises(InputError, match="detail|budget"):
        detail_level(**dict(detail=None, config=ModelConfig(), photo_px=50) | options)
    with pytest.raises(InputError, match="detail|budget"):
        PhotoEncoder(tiny_net(), PANEL, **options)


def test_the_encoder_draws_what_is_predicted():
    net, rgba = tiny_net(), photo(60, 90)
    encoder = PhotoEncoder(net, PANEL, detail=2)
    encoder(rgba)
    gaussians = net.predict(rgba, detail_level(2, net.config, 90, PANEL))
    assert encoder.gaussians.count == gaussians.count > net.predict(rgba).count
    assert torch.equal(encoder.gaussians.means, gaussians.means)


def test_outlines_are_where_the_photo_has_them():
    """Optical depths of overlapping texels add up.

    If opacities were blurred as they are, half-covered pixels would be drawn nearly opaque. The object would be larger
    by half a pixel all round (0.54, and 0.26 of opacity at the rim).
    """
    truth = picture(2 * SIZE)[0, 3]
    _, alpha = drawn(detailed(slanted(), 2, opacity=0.01), 2)
    errors = alpha / alpha[truth == 1].median() - truth
    assert errors.sum().abs() / (2 * math.pi * 0.4 * 2 * SIZE) < 0.3  # over the outline's length
    assert errors[(truth > 0) & (truth < 1)].abs().mean() < 0.15
