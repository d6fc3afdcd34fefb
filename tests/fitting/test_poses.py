"""Poses: the gradient of a motion against differences, and cameras that are off come back."""

from __future__ import annotations

import pytest
import torch
from fit_scene import known_cameras, known_scene, photograph_scene, psnr_db
from torch import Tensor

from lightfield_gs.fitting.evaluate import align_poses
from lightfield_gs.fitting.image_optimizers import (
    PoseOptimizer,
    apply_twists,
    remove_common_motion,
    rotation_matrices,
    twist_gradients,
)
from lightfield_gs.fitting.optimizer import GaussianState
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer
from lightfield_gs.rasterizer.image_render import ImageArguments, ImageBuffers, ImageRender
from lightfield_gs.rasterizer.workspace import GradientRequest

DOUBLE = torch.float64


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))


def shaken(poses: Tensor, size: float) -> Tensor:
    """Poses after random motions, none of which is common to all."""
    twists = remove_common_motion(poses.double(), size * random(len(poses), 6, seed=3))
    return apply_twists(poses.double(), twists).to(poses)


def test_rotations_are_exponentials():
    turns = torch.cat([random(20, 3), torch.zeros(1, 3, dtype=DOUBLE), 1e-9 * random(1, 3)])
    x, y, z = turns.unbind(-1)
    cross = torch.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x], -1).view(-1, 3, 3)
    torch.testing.assert_close(rotation_matrices(turns), torch.linalg.matrix_exp(cross))


def test_the_gradient_of_a_motion_is_that_of_autograd():
    poses, weights = known_cameras().world_to_camera.double(), random(6, 4, 4)
    weights[:, 3] = 0
    at_rest = 1e-9 * torch.ones(6, 6, dtype=DOUBLE)  # the norm has no derivative at none at all
    twists = at_rest.requires_grad_()
    (apply_twists(poses, twists) * weights).sum().backward()
    torch.testing.assert_close(twist_gradients(poses, weights), twists.grad, atol=1e-7, rtol=1e-7)


def test_the_gradient_of_a_motion_is_that_of_the_image():
    """Through the rasterizer in double, against central differences."""
    scene, cameras, background = known_scene(60, 1), known_cameras(2, 24, 16), torch.zeros(1, 2, 3, dtype=DOUBLE)
    poses, weights = cameras.world_to_camera.double(), random(1, 2, 16, 24, 3)
    fields = [field.double()[None] for field in scene.fields().values()]
    optics = [tensor.double()[None] for tensor in (cameras.intrinsics(), cameras.limits())]

    def drawn(twists: Tensor) -> tuple[ImageRender, ImageBuffers]:
        job = ImageRender.from_arguments(
            ImageArguments(*fields, background, apply_twists(poses, twists)[None], *optics, 24, 16)
        )
        return job, job.draw()

    job, images = drawn(torch.zeros(2, 6, dtype=DOUBLE))
    gradients = job.backward(images, ImageBuffers(weights, None, None), GradientRequest(cameras=True))
    found = twist_gradients(poses, gradients.cameras)
    for view in range(2):
        for number in range(6):
            step = torch.zeros(2, 6, dtype=DOUBLE)
            step[view, number] = 1e-6
            difference = sum(sign * float((drawn(sign * step)[1].image * weights).sum()) for sign in (1, -1)) / 2e-6
            assert found[view, number] == pytest.approx(difference, rel=1e-3, abs=1e-3)


def test_what_cameras_have_in_common_is_no_motion_of_theirs():
    """A rigid motion of the world is removed completely, and the rest has none of it."""
    poses = known_cameras().world_to_camera.double()
    world = 1e-4 * random(6)
    carried = poses @ apply_twists(torch.eye(4, dtype=DOUBLE), world)
    shift, turn = carried[:, :3, 3], carried[:, :3, :3] @ poses[:, :3, :3].transpose(1, 2)
    skew = (turn - turn.transpose(1, 2)) / 2
    turns = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
    common = torch.cat([shift - (turn @ poses[:, :3, 3:])[..., 0], turns], -1)
    assert remove_common_motion(poses, common).abs().max() < 2e-3 * common.abs().max()
    rest = remove_common_motion(poses, random(6, 6))
    torch.testing.assert_close(remove_common_motion(poses, rest), rest)


def test_a_void_step_moves_nothing():
    poses = PoseOptimizer(known_cameras().world_to_camera, 10, 1e-3)
    before = {name: tensor.clone() for name, tensor in poses.tensors().items()}
    poses.update(random(6, 6) * torch.nan, torch.tensor([3]), torch.tensor([0]))
    assert all(tensor.equal(before[name]) for name, tensor in poses.tensors().items())


def off(poses: Tensor, right: Tensor) -> float:
    """How far cameras are from where they should be, root mean square, extents and radians together."""
    return float((poses - right)[:, :3].double().square().sum((1, 2)).mean().sqrt())


def test_cameras_that_are_off_come_back():
    """The scene is known, but for its colours, and all of it is drawn: only the poses can explain the photographs."""
    scene = known_scene()
    images = photograph_scene(scene)
    right = images.world_to_camera
    images.world_to_camera = shaken(right, 0.004)
    settings = FitSettings(steps=150, cap_max=scene.count, sh_degree=0, refine_start_iter=30_000, poses=True)
    still = dict(means_lr=0.0, scales_lr=0.0, quats_lr=0.0, opacities_lr=0.0, noise_lr=0.0)
    settings = FitSettings(**vars(settings) | still | dict(poses_lr=1e-3, opacity_reg=0.0, scale_reg=0.0, dropout=0.0))
    trainer = Trainer(GaussianState.start(scene), images, settings)
    trainer.advance(settings.steps)
    assert trainer.poses is not None and not trainer.poses.world_to_camera.equal(images.world_to_camera)
    assert off(trainer.poses.world_to_camera, right) < 0.4 * off(images.world_to_camera, right)
    rotation = trainer.poses.world_to_camera[:, :3, :3]
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), torch.eye(3).expand(6, 3, 3), atol=1e-6, rtol=0)


def test_held_out_cameras_are_aligned():
    scene = known_scene()
    images = photograph_scene(scene)
    right = images.world_to_camera
    images.world_to_camera = apply_twists(right.double(), 0.004 * random(6, 6, seed=3)).float()
    before = psnr_db(GaussianState.start(scene), images)
    found = align_poses(images, scene, FitSettings(), steps=60)
    # What is left is mostly a turn that undoes a shift
    assert off(found.world_to_camera, right) < 0.45 * off(images.world_to_camera, right)
    assert psnr_db(GaussianState.start(scene), found) > before + 10
    at_once = align_poses(photograph_scene(scene), scene, FitSettings(), steps=3)
    assert at_once.world_to_camera.equal(right)
