"""Gaussians near the cameras, whose colours vary fast over a rig; and cameras far from the origin."""

import numpy as np
import pytest
import torch

from lightfield_gs import Cameras, Gaussians, Panel, Rig, encode, render
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.scene.cameras import recentre

ZERO_DEPTH = 2.0


def panel_of(cone_deg, width_px=96, height_px=8, views=48):
    return Panel(
        width_px=width_px, height_px=height_px, views=views, line_number=9.848, slant_tan=1 / 6, cone_deg=cone_deg
    )


def rig_of(panel, x=0.0):
    pose = np.eye(4)
    pose[0, 3] = -x
    focal = (panel.width_px, panel.width_px)
    return Rig(pose, focal, (panel.width_px / 2, panel.height_px / 2), ZERO_DEPTH)


def one_gaussian(random, depth, degree=3, aside=0.0, scale=0.3):
    """One that covers the panel from every camera, float64."""
    mean = torch.tensor([[aside, 0.1 * depth, depth]], dtype=torch.float64)
    sh = torch.from_numpy(random.normal(size=(1, (degree + 1) ** 2, 3)) * scale)
    turn, size, opacity = torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 50 * depth), torch.ones(1)
    return Gaussians(mean, turn.double(), size.double(), opacity.double(), sh)


def scene_near(random, degree, nearest, count=90):
    """A third of the Gaussians stands at nearest to twice nearest of the depth of the zero plane, float32."""
    z = np.r_[random.uniform(nearest, 2 * nearest, count // 3) * ZERO_DEPTH, random.uniform(1.6, 2.4, 2 * count // 3)]
    means = np.c_[random.uniform(-0.5, 0.5, count) * z, random.uniform(-0.25, 0.25, count) * z, z]
    fields = (
        means,
        random.normal(size=(count, 4)),
        np.full((count, 3), 0.04) * z[:, None],
        random.uniform(0.4, 1, count),
        random.normal(size=(count, (degree + 1) ** 2, 3)) * 0.2,
    )
    return Gaussians(*(torch.tensor(field, dtype=torch.float32) for field in fields))


@pytest.mark.parametrize("cone_deg", [20, 53, 120])
@pytest.mark.parametrize("depth", [0.02, 0.1, 0.4, 2.0])
def test_colours_are_those_of_the_views_however_near(cone_deg, depth):
    panel, random = panel_of(cone_deg), np.random.default_rng(1)
    scene, stats = one_gaussian(random, depth), {}
    direct = encode(scene, panel, rig_of(panel), output="float64", stats=stats)
    assert (direct - encode(scene, panel, rig_of(panel), "sorted", output="float64")).abs().max() < 1e-9
    assert stats["colour_error"] <= 1e-12


@pytest.mark.parametrize("degree", [1, 3])
@pytest.mark.parametrize("nearest", [0.05, 0.2])
def test_a_scene_near_the_cameras_is_right_to_a_byte(nearest, degree):
    panel, stats = panel_of(53, 160, 80, 96), {}
    scene = scene_near(np.random.default_rng(2), degree, nearest)
    direct = encode(scene, panel, rig_of(panel), stats=stats).int()
    assert (direct - encode(scene, panel, rig_of(panel), "sorted").int()).abs().max() <= 1
    assert stats["colour_error"] <= 1e-4 and (nearest > 0.1 or stats["skipped"]["colours_exact"] > 0)
    exact = encode(scene, panel, rig_of(panel), output="float32")
    for name in ("high", "fast", "draft"):  # in lattices and in rough tiles
        error = (encode(scene, panel, rig_of(panel), output="float32", quality=name) - exact).abs()
        quality = Quality.of(name)
        assert error.mean() < quality.lattice_error / 10 + quality.opacity_cut, name


def test_colour_error_is_a_bound():
    random, tightest, plain = np.random.default_rng(3), [], 0
    for _ in range(120):
        panel, depth = panel_of(random.uniform(10, 110), height_px=1), 2 * np.exp(random.uniform(-3, 1))
        degree, allowed = int(random.integers(1, 4)), 10 ** random.uniform(-4, -0.5)
        scene = one_gaussian(random, depth, degree, random.normal() * 0.5, random.choice([0.03, 0.3]))
        stats, quality = {}, Quality(colour_error=allowed)
        shown = encode(scene, panel, rig_of(panel), output="float32", quality=quality, stats=stats).double()
        error = (shown - encode(scene, panel, rig_of(panel), "sorted", output="float64")).abs().max()
        assert error <= stats["colour_error"] + 2e-5 and stats["colour_error"] <= 2 * allowed
        plain += stats["skipped"]["colours_exact"] == 0
        if error > 1e-4:
            tightest.append(float(stats["colour_error"] / error))
    assert plain > 60 and min(tightest) > 0.9 and np.median(tightest) < 6


@pytest.mark.parametrize("depth", [0.1, 0.5])
def test_gradients_of_colours_near_the_cameras(depth):
    panel, random = panel_of(53, 24, 4), np.random.default_rng(4)
    scene = one_gaussian(random, depth, aside=0.05, scale=0.1)
    weights = torch.from_numpy(random.normal(size=(4, 24, 3)))
    mean, sh = (t.clone().requires_grad_() for t in (scene.means, scene.sh))

    def loss(mean, sh):
        moved = Gaussians(mean, scene.quaternions, scene.scales, scene.opacities, sh)
        return (weights * encode(moved, panel, rig_of(panel), output="float64")).sum()

    loss(mean, sh).backward()
    for which, given in enumerate((mean, sh)):
        for place in range(0, given.numel(), 1 if which == 0 else 7):
            step = torch.zeros_like(given).flatten()
            step[place] = 1e-6
            ends = []
            for sign in (-1, 1):
                there = [scene.means, scene.sh]
                there[which] = there[which] + sign * step.view_as(given)
                ends.append(float(loss(*there)))
            expected = (ends[1] - ends[0]) / 2e-6
            assert float(given.grad.flatten()[place]) == pytest.approx(expected, rel=2e-5, abs=2e-5)


def scene_far(far):
    random = np.random.default_rng(5)
    means = random.normal(size=(150, 3)) * [0.6, 0.4, 0.3] + [far, 0, 2]
    sizes = np.exp(random.normal(size=(150, 3)) * 0.5) * 0.05
    fields = (means, random.normal(size=(150, 4)), sizes, random.uniform(0.2, 1, 150), random.normal(size=(150, 4, 3)))
    return Gaussians(*(torch.tensor(field, dtype=torch.float32) for field in fields))


def single(x):
    """One camera that looks at the scene, turned a little."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[0, 0] = pose[2, 2] = np.cos(0.1)
    pose[0, 2], pose[2, 0] = np.sin(0.1), -np.sin(0.1)
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, 0.0, 0.0], dtype=torch.float64)
    return Cameras(pose[None], torch.tensor([[96.0, 96]]), torch.tensor([[48.0, 24]]), 96, 48)


@pytest.mark.parametrize("far", [1e3, 1e5, 1e6])
def test_far_from_the_origin_float32_draws_what_float64_does(far):
    scene, panel = scene_far(far), panel_of(40, 96, 48, 16)
    expected = encode(scene, panel, rig_of(panel, far), output="float64")
    for method in ("sorted", "classic"):
        error = (encode(scene, panel, rig_of(panel, far), method, output="float32") - expected).abs()
        assert error.max() < 1 / 255 and error.mean() < 1e-5, method
    error = (render(scene, single(far)).image - render(scene.to(torch.float64), single(far)).image).abs()
    assert error.max() < 1 / 255 and error.mean() < 1e-5


def test_gradients_far_from_the_origin_are_those_of_float64():
    found = []
    for dtype in (torch.float32, torch.float64):
        scene, cameras = scene_far(1e5).to(dtype), single(1e5)
        scene.means.requires_grad_(), cameras.world_to_camera.requires_grad_()
        render(scene, cameras).image[0, :, ::2].square().sum().backward()
        rows, pose = cameras.world_to_camera.grad[0, :3].double(), cameras.world_to_camera.detach()[0].double()
        turned = rows @ pose[:3].mT  # what a motion of the camera changes: the antisymmetric part
        found.append([scene.means.grad.double(), rows[:, 3], turned - turned.mT])
    for of_single, of_double in zip(*found, strict=True):
        assert (of_single - of_double).abs().max() < 1e-3 * of_double.abs().max()


def test_at_ordinary_places_nothing_is_taken_off():
    for far in (0.0, 30.0):
        scene, cameras = scene_far(far), single(far)
        means, same = recentre(scene.means, cameras)
        assert means is scene.means and same is cameras
