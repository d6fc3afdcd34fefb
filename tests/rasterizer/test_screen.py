"""Gradients of projected means and radii of splats, as render gives them for density control."""

from __future__ import annotations

import pytest
import torch
from rasterizer_cases import random_scene, stacked, turned_pose

import lightfield_gs as lf
from lightfield_gs import InputError
from lightfield_gs.scene.gaussians import Gaussians

WIDTH, HEIGHT, COUNT = 20, 14, 12


def cameras(shift: tuple[float, float] = (0, 0), size: tuple[int, int] = (WIDTH, HEIGHT)) -> lf.Cameras:
    """Two cameras, with principal points moved, but not the limits of the Jacobian."""
    poses = torch.stack([torch.from_numpy(turned_pose(0.3, 0.1)), torch.from_numpy(turned_pose(-0.2, -0.15))])
    middle = torch.tensor([size[0] * 0.47, size[1] * 0.53], dtype=torch.float64).expand(2, 2)
    limits = lf.Cameras(poses, torch.full((2, 2), 1.2 * size[0]).double(), middle, *size).limits()
    moved = middle + torch.tensor(shift, dtype=torch.float64)
    return lf.Cameras(poses, torch.full((2, 2), 1.2 * size[0]).double(), moved, *size, limits)


def parts_of(scene: Gaussians, indices: slice) -> Gaussians:
    return Gaussians(*(field[indices] for field in scene.fields().values()))


def screen_gradients(scene: Gaussians, seen: lf.Cameras, weights: torch.Tensor, numbers: int = 4) -> torch.Tensor:
    shape = (*scene.means.shape[:-2], 2, scene.count, numbers)
    screen = torch.zeros(shape, dtype=scene.dtype, requires_grad=True)
    (lf.render(scene, seen, screen=screen).image * weights).sum().backward()
    assert screen.grad is not None
    return screen.grad


WEIGHTS = torch.rand(2, HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)


@pytest.mark.parametrize("part", [slice(i, i + 1) for i in range(6)] + [slice(0, COUNT)])
def test_gradients_are_those_of_a_shift_of_the_principal_point(part):
    scene = parts_of(random_scene(COUNT, seed=2, extent=0.4, size=0.12), part)
    found = screen_gradients(scene, cameras(), WEIGHTS)[..., :2].sum(1)  # all Gaussians move at once
    step = 1e-5
    for axis, (dx, dy) in enumerate([(step, 0.0), (0.0, step)]):
        there, back = (lf.render(scene, cameras(shift)).image for shift in ((dx, dy), (-dx, -dy)))
        want = ((there - back) * WEIGHTS).sum((1, 2, 3)) / (2 * step)
        assert torch.allclose(found[:, axis], want, rtol=1e-5, atol=1e-6)


def test_gradients_of_each_among_others_are_those_of_its_place():
    """So far away, where a Gaussian that moves does not change its shape."""
    far, scene = 1e5, random_scene(COUNT, seed=3, extent=0.4, size=0.12)
    scene.means[:, 2] += far
    scene.means.requires_grad_()
    poses, focal = torch.eye(4).double().expand(2, 4, 4), torch.full((2, 2), 15 * far).double()
    seen = lf.Cameras(poses, focal, torch.tensor([[9.0, 7.0], [11.0, 6.0]]).double(), WIDTH, HEIGHT)
    found = screen_gradients(scene, seen, WEIGHTS, 2).sum(0)
    moved = scene.means.grad[:, :2] * scene.means.detach()[:, 2:] / (15 * far)
    assert torch.allclose(found, moved, rtol=1e-3, atol=1e-5)


def test_absolute_gradients_are_summed_over_pixels():
    scene = random_scene(COUNT, seed=4, extent=0.3, size=0.1)
    size = (6, 5)
    weights = WEIGHTS[:, : size[1], : size[0]]
    whole = screen_gradients(scene, cameras(size=size), weights)
    parts = []
    for pixel in range(size[0] * size[1]):
        alone = torch.zeros(size[0] * size[1], dtype=torch.float64)
        alone[pixel] = 1
        parts.append(screen_gradients(scene, cameras(size=size), weights * alone.view(1, size[1], size[0], 1), 2))
    assert torch.allclose(whole[..., :2], sum(parts), atol=1e-12)
    assert torch.allclose(whole[..., 2:], sum(part.abs() for part in parts), atol=1e-12)
    assert (whole[..., 2:] >= whole[..., :2].abs() - 1e-12).all() and whole.any()


@pytest.mark.parametrize("antialiased", [False, True])
def test_radii_reach_to_where_alpha_is_one_in_255(antialiased):
    size, options = (160, 120), {"alpha": True, "radii": True, "antialiased": antialiased}
    for seed in range(6):
        scene = random_scene(1, seed=seed, extent=0.05, size=0.05, dtype=torch.float32)
        image, alpha, _, radii = lf.render(scene, cameras(size=size).to(torch.float32), **options)
        assert radii.shape == (2, 1) and image.shape == (2, 120, 160, 3)
        for covered, radius in zip(alpha >= 0.999 / 255, radii[:, 0]):
            places = covered.nonzero().float()
            reach = torch.cdist(places, places).max() / 2  # half the longest extent, but for less than a pixel
            assert reach <= radius + 1e-3 and radius < reach + 1


def test_radii_are_the_same_with_gradients_and_in_batches():
    scene = random_scene(COUNT, seed=6, dtype=torch.float32)
    scene.means[0] = torch.tensor([0.0, 0.0, -5.0])  # behind the cameras
    seen = cameras().to(torch.float32)
    image, alpha, depth, radii = lf.render(scene, seen, radii=True)
    assert alpha is None and depth is None
    assert radii[0, 0] == 0 and (radii[:, 1:] > 0).any()
    both = stacked([scene, scene])
    both.means.requires_grad_()
    screen = torch.zeros(2, 2, COUNT, 2, requires_grad=True)
    images, alpha, depth, again = lf.render(both, seen, alpha=True, depth=True, screen=screen, radii=True)
    assert torch.equal(again, torch.stack([radii, radii])) and not again.requires_grad
    assert torch.equal(images[1], image)
    images.square().sum().backward()
    assert screen.grad is not None and torch.equal(screen.grad[0], screen.grad[1]) and screen.grad.any()
    assert both.means.grad is not None and both.means.grad.any()


@pytest.mark.parametrize(
    "screen",
    [
        [0.0, 0.0],
        torch.zeros(2, COUNT, 3, requires_grad=True),
        torch.zeros(1, COUNT, 2, requires_grad=True),
        torch.zeros((), requires_grad=True),
        torch.zeros(2, COUNT, 2, requires_grad=True, dtype=torch.float64),
        torch.zeros(2, COUNT, 2),
    ],
)
def test_what_is_no_screen_is_refused(screen):
    with pytest.raises(InputError, match="screen"):
        lf.render(random_scene(COUNT, dtype=torch.float32), cameras().to(torch.float32), screen=screen)


def test_radii_must_be_a_choice():
    with pytest.raises(InputError, match="radii"):
        lf.render(random_scene(COUNT), cameras(), radii=1)  # type: ignore[arg-type]
