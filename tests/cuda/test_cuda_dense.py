"""Ordinary images on CUDA where kernels could go wrong: odd sizes, deep stacks, early stops, too much. Needs a GPU."""

from __future__ import annotations

import pytest
import torch
from rasterizer_cases import dense_views, hard_scene, random_scene, stacked

from benchmarks import training_step
from lightfield_gs import Gaussians, _core

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)

HARD = ("clamped", "needles", "huge", "opaque", "specks", "near and far", "equal depths")
SIZES = [(1, 1), (16, 16), (17, 15), (8, 4), (129, 33), (3, 70)]


def bright(scene: Gaussians) -> Gaussians:
    """Colours well above zero: at the clamp there, the gradient jumps with the last digit."""
    sh = scene.sh.clone()
    sh[:, 0] += 4
    return Gaussians(scene.means, scene.quaternions, scene.scales, scene.opacities, sh)


def deep_stack(count: int, opacity: float) -> Gaussians:
    """Gaussians one behind the other, more than a tile stages at a time, over a few pixels."""
    scene = bright(random_scene(count, 1, seed=2, extent=0.05, size=0.02))
    scene.opacities[:] = opacity
    scene.means[:, 2] = torch.linspace(1.5, 3, count).flip(0)
    return scene


def render(scenes: list[Gaussians], width: int, height: int, device: str, views: int = 2):
    """Leaves and outputs of render_images; float64 on the CPU."""
    like = torch.empty((), device=device, dtype=torch.float64 if device == "cpu" else torch.float32)
    leaves = [t.to(like).requires_grad_() for t in stacked(scenes).fields().values()]
    poses, *fixed = (t.to(like) for t in dense_views(len(scenes), views, width, height))
    leaves += [torch.full((len(scenes), views, 3), 0.3).to(like).requires_grad_(), poses.requires_grad_()]
    return leaves, torch.ops.lightfield_gs.render_images(*leaves, *fixed, width, height)


def gradients(scenes: list[Gaussians], width: int, height: int, device: str) -> list[torch.Tensor]:
    leaves, outputs = render(scenes, width, height, device)
    random = torch.Generator().manual_seed(5)
    loss = sum((out * torch.randn(out.shape, generator=random, dtype=torch.float64).to(out)).sum() for out in outputs)
    return list(torch.autograd.grad(loss, leaves))


def agree(scenes: list[Gaussians], width: int, height: int, samples_off: int = 0, error: float = 1e-3) -> None:
    """Images but for `samples_off` samples on a threshold, and gradients, are those of float64 on the CPU."""
    with torch.no_grad():
        expected, found = (render(scenes, width, height, device)[1] for device in ("cpu", "cuda"))
    for a, b in zip(expected, found):
        assert ((a - b.cpu()).abs() > 1 / 255).sum() <= samples_off
    for a, b in zip(*(gradients(scenes, width, height, device) for device in ("cpu", "cuda"))):
        assert (b.cpu().double() - a).norm() <= error * a.norm() + 1e-12


@pytest.mark.parametrize("size", SIZES)
def test_images_of_any_size(size):
    agree([bright(random_scene(300, 1, seed=seed)) for seed in range(3)], *size, samples_off=2)


@pytest.mark.parametrize("kind", HARD)
def test_hard_scenes(kind):
    agree([bright(hard_scene(kind, 200, seed)) for seed in (3, 4)], 61, 45, samples_off=4)


@pytest.mark.parametrize("opacity", [0.02, 0.3, 1.0])
def test_stacks_deeper_than_a_batch(opacity):
    agree([deep_stack(1500, opacity)], 40, 30, samples_off=4)


def test_stacks_have_the_same_gradients_in_every_run():
    scenes = [deep_stack(1500, 0.3), deep_stack(1500, 0.02)]
    for a, b in zip(gradients(scenes, 40, 30, "cuda"), gradients(scenes, 40, 30, "cuda")):
        assert torch.equal(a, b)


@pytest.mark.parametrize("count", [0, 1])
def test_few_gaussians_over_everything(count):
    scene = bright(random_scene(1, 0, seed=1, size=5))
    agree([Gaussians(*(field[:count] for field in scene.fields().values()))] * 2, 133, 61)


def test_more_pairs_than_can_be_counted_are_refused():
    many = 300  # each in all of the 16.8 million tiles
    like = torch.empty((), device="cuda")
    scene = [t[None].to(like) for t in random_scene(many).fields().values()]
    scene[2], scene[3] = torch.full_like(scene[2], 1e5), torch.ones_like(scene[3])
    views = [t.to(like) for t in dense_views(1, 1, 65536, 65536)]
    with pytest.raises(ValueError, match="intersections of tile and Gaussian"):
        torch.ops.lightfield_gs.render_images(*scene, like.new_zeros(1, 1, 3), *views, 65536, 65536)


def test_the_training_step_can_be_timed(monkeypatch):
    monkeypatch.setattr(training_step, "SCENES", 2)
    monkeypatch.setattr(training_step, "SIZE_PX", 16)
    row = training_step.cuda_row(1)
    assert row["images"] == 8 and row["gaussians"] == 256 and 0 < row["ms_forward"] < row["ms_total"]
    assert row["card"] in training_step.table([row])


def test_more_images_than_a_launch_takes_are_refused():
    with pytest.raises(ValueError, match="65536 images, and at most 65,535"), torch.no_grad():
        render([random_scene(1)], 1, 1, "cuda", views=65536)
