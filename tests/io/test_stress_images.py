"""Ordinary images, their alpha, depth and gradients at the extremes of stress_cases, against the float64 oracle."""

from functools import cache

import numpy as np
import pytest
import torch
from rasterizer_cases import stacked
from stress_cases import BACKENDS, BACKGROUND, CASES, EXACT, SETTLED, check_gradients, one_thread, use_backend

from lightfield_gs import Gaussians, reference, render

OF_SCENES = [name for name, case in CASES.items() if not case.panel]  # panels do not matter here


@pytest.fixture(params=BACKENDS)
def device(request):
    with use_backend(request.param) as device:
        yield device


def views(case):
    """Three cameras of the case's rig: outermost, one at the middle, outermost."""
    shown, fan = case.view()
    return fan.cameras(shown, [0, 11, 23])


@cache
def oracle(name):
    """Scene, cameras, images [3, H, W, 3] and their margins."""
    case = CASES[name]
    scene, cameras = case.scene(), views(case)
    rows, columns, channels = (index.ravel() for index in np.indices((cameras.height_px, cameras.width_px, 3)))
    with one_thread():
        parts = [
            reference.pixel_colours(
                scene, cameras, camera, rows, columns, channels, background=BACKGROUND, return_margin=True
            )
            for camera in range(3)
        ]
    shape = (3, cameras.height_px, cameras.width_px, 3)
    return scene, cameras, *(np.stack(part).reshape(shape) for part in zip(*parts))


@pytest.mark.parametrize("name", OF_SCENES)
def test_float64_is_the_oracle(name):
    scene, cameras, want, margin = oracle(name)
    exact = render(scene, cameras, background=BACKGROUND).image.numpy()
    assert np.isfinite(exact).all() and (margin > 1e-7).mean() > 0.99
    assert np.abs(exact - want)[margin > 1e-7].max() < EXACT


@pytest.mark.parametrize("name", OF_SCENES)
def test_float32_is_near_the_oracle(name, device):
    scene, cameras, want, margin = oracle(name)
    single = (
        render(scene.to(device, torch.float32), cameras.to(device=device, dtype=torch.float32), background=BACKGROUND)
        .image.cpu()
        .numpy()
    )
    assert np.isfinite(single).all() and (margin > SETTLED).mean() > 0.6
    assert np.abs(single - want)[margin > SETTLED].max() < CASES[name].single


def gradients(draw, scene):
    """Of a loss in which every number of image, alpha and depth counts, with respect to the five fields."""
    leaves = [field.detach().clone().requires_grad_() for field in scene.fields().values()]
    parts = draw(Gaussians(*leaves))
    loss = sum((part * torch.linspace(-1, 2, part.numel()).to(part).view_as(part)).sum() for part in parts)
    return torch.autograd.grad(loss, leaves)


def weighted_depth(image, alpha, depth):
    return image, alpha, depth * alpha  # what the oracle has: depth is divided by the coverage


def dense_gradients(scene, cameras):
    like = cameras.to(device=scene.means.device, dtype=scene.means.dtype)
    return gradients(
        lambda g: weighted_depth(*render(g, like, background=BACKGROUND, alpha=True, depth=True)[:3]), scene
    )


@cache
def double_gradients(name):
    """Double precision is compiled for one vector set: its gradients are the same on every backend."""
    case = CASES[name].smaller()
    return dense_gradients(case.scene(), views(case))


@cache
def oracle_gradients(name):
    case = CASES[name].smaller()
    scene, cameras = case.scene(), views(case)
    each = [t.unsqueeze(0).double() for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())]
    background = torch.tensor(BACKGROUND, dtype=torch.float64).expand(1, 3, 3)

    def draw(g):
        return reference.dense_torch(
            *stacked([g]).fields().values(), background, *each, cameras.width_px, cameras.height_px
        )

    with one_thread():
        return case, cameras, gradients(draw, scene)


@pytest.mark.parametrize("name", [name for name in OF_SCENES if CASES[name].count])
def test_gradients_are_finite_and_those_of_the_oracle(name, device):
    case, cameras, want = oracle_gradients(name)
    single = dense_gradients(case.scene().to(device, torch.float32), cameras)
    check_gradients(case, want, single, double_gradients(name), case.gradient_cuda if device.type == "cuda" else 0)
