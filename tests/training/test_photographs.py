"""Faults of photographs on input pictures, and errors of poses."""

import numpy as np
import torch

from training.data.batches import make_batch
from training.data.cache import load_set
from training.data.photographs import PhotoPlan, draw_faults, photographed
from training.data.plan import Augmentation, BatchPlanner
from training.data.resident import ResidentViews
from training.data.sampler import ViewSampler


def _faults(count: int, **changes) -> PhotoPlan:
    names = ("blur", "noise", "outline", "softness")
    values = {name: torch.full((count,), float(changes.get(name, 0))) for name in names}
    return PhotoPlan(**values, backgrounds=torch.tensor([[0.0, 1.0, 0.0]]).expand(count, 3), seeds=torch.arange(count))


def _disc(size: int = 64, radius: float = 20) -> torch.Tensor:
    """A grey disc [1,4,size,size], antialiased."""
    place = torch.arange(size) + 0.5 - size / 2
    alpha = (radius + 0.5 - torch.hypot(place, place[:, None])).clamp(0, 1)
    return torch.stack([0.5 * alpha, 0.5 * alpha, 0.5 * alpha, alpha])[None]


def test_no_fault_changes_nothing():
    images = torch.rand(3, 4, 16, 16)
    images[:, :3] *= images[:, 3:]
    torch.testing.assert_close(photographed(images, _faults(3)), images, atol=1e-6, rtol=0)


def test_blur_has_the_width_that_it_says():
    point = torch.zeros(2, 4, 33, 33)
    point[:, :, 16, 16] = 1
    for deviation in (0.6, 1.5):
        found = photographed(point, _faults(2, blur=deviation))[1]
        place = torch.arange(33) - 16.0
        torch.testing.assert_close(found.sum((1, 2)), torch.ones(4), atol=1e-4, rtol=0)
        variance = (found[3].sum(0) * place**2).sum()
        assert abs(float(variance) - deviation**2) < 0.05


def test_noise_has_the_strength_that_it_says_and_stays_on_the_object():
    images = _disc().expand(2, -1, -1, -1)
    found = photographed(images, _faults(2, noise=0.05))
    inside = images[0, 3] == 1
    changes = (found - images)[:, :3, inside]
    assert abs(float(changes.std()) - 0.05) < 0.003 and abs(float(changes.mean())) < 0.003
    assert abs(float(torch.corrcoef(changes.flatten(1))[0, 1])) < 0.05  # every picture has noise of its own
    assert (found[:, :, images[0, 3] == 0] == 0).all() and torch.equal(found[:, 3], images[:, 3])


def test_outlines_move_as_far_as_they_say():
    images = _disc()
    for outline in (-1.0, 0.0, 1.0):
        found = photographed(images, _faults(1, outline=outline, softness=1.2))
        radius = (found[0, 3].sum() / np.pi).sqrt()
        assert abs(float(radius) - 20 - outline) < 0.2
        assert (found[:, :3] <= found[:, 3:] + 1e-6).all()
    green = found[0, 1] - found[0, 0]  # of the photo's background, where the cut-out takes in some of it
    assert green.max() > 0.2 and green[32, 32] < 1e-5


def test_half_of_the_pictures_are_spared_each_fault():
    faults = draw_faults(np.random.default_rng(0), 2000, 1.5, 0.1, 2.0)
    for values, limit in ((faults.blur, 1.5), (faults.noise, 0.1), (faults.softness, 2.0)):
        assert 0.45 < (values == 0).float().mean() < 0.55 and 0.95 * limit < values.max() <= limit
    assert (faults.outline.abs() <= faults.softness).all() and faults.outline.min() < -1 and faults.outline.max() > 1


def _planner(folder, **augmentation) -> BatchPlanner:
    cached = load_set(folder / "set", folder / "cache", workers=1)
    sampler = ViewSampler([views.camera_to_world for views in cached.objects], 30, 12, 2, seed=0)
    return BatchPlanner(ResidentViews([cached]), sampler, Augmentation(**augmentation), procedural=0.5)


def test_faults_are_those_of_the_input_pictures_alone(small_set):
    """The same in any part of a step; everything but the input pictures as without faults."""
    clean, faulty = (_planner(small_set, **faults) for faults in ({}, {"blur_px": 2, "noise": 0.1, "outline_px": 2}))
    expected, found = (make_batch(planner.plan(2, 12, 6, 16), planner.views) for planner in (clean, faulty))
    assert (found.source != expected.source).flatten(1).any(1).sum() >= 3
    for name in ("source_intrinsics", "targets", "intrinsics", "world_to_camera", "backgrounds"):
        assert torch.equal(getattr(found, name), getattr(expected, name))
    part = make_batch(faulty.plan(2, 12, 6, 16, part=slice(2, 4)), faulty.views)  # examples 2 (stored) and 3 (made)
    torch.testing.assert_close(part.source, found.source[[1, 4]], atol=1e-5, rtol=0)


def test_pose_errors_turn_the_other_cameras_a_little(small_set):
    exact, wrong = (_planner(small_set, pose_error_deg=limit).plan(1, 8, 8, 16).world_to_camera for limit in (0.0, 0.5))
    assert torch.equal(exact[:, 0], wrong[:, 0])
    turn = (wrong @ torch.linalg.inv(exact))[:, 1:]
    angle = torch.rad2deg(torch.linalg.matrix_norm(turn[..., :3, :3] - torch.eye(3)) / 2**0.5)
    assert 0.05 < angle.max() < 0.5 * 3**0.5 + 1e-3
    torch.testing.assert_close(turn[..., :3, 3], torch.zeros(*turn.shape[:2], 3), atol=1e-5, rtol=0)  # about themselves
