"""The light field and its gradients at the extremes of stress_cases, against the float64 oracle, on every backend."""

from functools import cache

import numpy as np
import pytest
import torch
from rasterizer_cases import all_subpixels, reached
from stress_cases import BACKENDS, BACKGROUND, CASES, EXACT, METHODS, SETTLED, check_gradients, one_thread, use_backend

from lightfield_gs import Gaussians, encode, reference
from lightfield_gs.rasterizer.quality import Quality


@pytest.fixture(params=BACKENDS)
def device(request):
    with use_backend(request.param) as device:
        yield device


@cache
def oracle(name):
    """Scene, panel, rig, colours and margins of a case."""
    case = CASES[name]
    scene, (shown, fan) = case.scene(), case.view()
    with one_thread():
        return (
            scene,
            shown,
            fan,
            *reference.subpixel_colours(
                scene, shown, fan, *all_subpixels(shown), background=BACKGROUND, return_margin=True
            ),
        )


@pytest.mark.parametrize("name", CASES)
def test_float64_is_the_oracle(name):
    scene, shown, fan, want, margin = oracle(name)
    image = encode(scene, shown, fan, background=BACKGROUND, output="float64").numpy().ravel()
    assert np.isfinite(image).all() and (margin > 1e-7).mean() > 0.99
    assert np.abs(image - want)[margin > 1e-7].max() < EXACT


@pytest.mark.parametrize("name", CASES)
def test_float32_is_near_the_oracle(name, device):
    scene, shown, fan, want, margin = oracle(name)
    image = encode(scene.to(device, torch.float32), shown, fan, background=BACKGROUND, output="float32").cpu()
    assert torch.isfinite(image).all() and (margin > SETTLED).mean() > 0.6
    assert np.abs(image.numpy().ravel() - want)[margin > SETTLED].max() < CASES[name].frame_bound(device)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("method", ["sorted", "classic"])
def test_the_other_methods_are_near_the_oracle(name, method, device):
    scene, shown, fan, want, margin = oracle(name)
    image = encode(scene.to(device, torch.float32), shown, fan, method, background=BACKGROUND, output="float32").cpu()
    assert np.abs(image.numpy().ravel() - want)[margin > SETTLED].max() < CASES[name].single


@cache
def given_up(name, quality):
    """Return the bound that a quality states for every sub-pixel of a case."""
    scene, shown, fan, *_ = oracle(name)
    with one_thread():
        cut = quality.opacity_cut * reached(scene, shown, fan)
    # A lattice is checked in the middle of its cells; elsewhere its error was never twice that
    return (
        cut + quality.transmittance_stop + quality.colour_error + 2 * quality.lattice_error + quality.evaluation_error
    )


@pytest.mark.parametrize("quality", ["high", "fast", "draft"])
@pytest.mark.parametrize("name", CASES)
def test_no_quality_gives_up_more_than_it_states(name, quality, device):
    scene, shown, fan, want, margin = oracle(name)
    image = encode(
        scene.to(device, torch.float32), shown, fan, background=BACKGROUND, output="float32", quality=quality
    ).cpu()
    assert torch.isfinite(image).all()
    error = np.abs(image.numpy().ravel() - want.clip(0, 1))
    bound = CASES[name].frame_bound(device) + given_up(name, Quality.of(quality))
    assert (error <= bound)[margin > SETTLED].all()


def gradients(draw, scene):
    """Of a loss in which every sub-pixel counts, with respect to the five fields."""
    leaves = [field.detach().clone().requires_grad_() for field in scene.fields().values()]
    image = draw(Gaussians(*leaves))
    return torch.autograd.grad((image * torch.linspace(-1, 2, image.numel()).to(image).view_as(image)).sum(), leaves)


@cache
def oracle_gradients(name):
    case = CASES[name].smaller()
    scene, (shown, fan) = case.scene(), case.view()
    background = torch.tensor(BACKGROUND, dtype=torch.float64)
    with one_thread():
        return case, gradients(lambda g: reference.lens_torch(*g.fields().values(), background, shown, fan), scene)


@cache
def double_gradients(name):
    """Double precision is compiled for one vector set: its gradients are the same on every backend."""
    case = CASES[name].smaller()
    return gradients(lambda g: encode(g, *case.view(), background=BACKGROUND, output="float64"), case.scene())


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.count])
def test_gradients_are_finite_and_those_of_the_oracle(name, device):
    case, want = oracle_gradients(name)
    shown, fan = case.view()
    single = gradients(
        lambda g: encode(g, shown, fan, background=BACKGROUND, output="float32"), case.scene().to(device, torch.float32)
    )
    check_gradients(case, want, single, double_gradients(name))
