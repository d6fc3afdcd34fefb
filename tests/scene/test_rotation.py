"""Gaussians.rotated: what cameras that are turned with the Gaussians see stays the same."""

import math

import numpy as np
import pytest
import torch
from rasterizer_cases import random_scene, turned_pose

from lightfield_gs import Cameras, Gaussians, InputError, reference, render

W, H = 40, 30


def some_rotation(seed: int) -> torch.Tensor:
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return torch.from_numpy(matrix * np.sign(np.linalg.det(matrix)))


def camera(pose: torch.Tensor) -> Cameras:
    return Cameras(
        pose[None],
        torch.tensor([[40.0, 42.0]], dtype=torch.float64),
        torch.tensor([[19.0, 16.0]], dtype=torch.float64),
        W,
        H,
    )


def counter_rotated(pose: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
    pose = pose.clone()
    pose[:3, :3] = pose[:3, :3] @ rotation.T
    return pose


@pytest.mark.parametrize("degree", range(4))
def test_turned_gaussians_look_the_same_to_turned_cameras(degree):
    scene = random_scene(40, degree, seed=degree, dtype=torch.float64)
    pose, rotation = torch.as_tensor(turned_pose(0.3, -0.2), dtype=torch.float64), some_rotation(degree)
    turned = scene.rotated(rotation)
    before, after = (render(s, camera(p)).image for s, p in ((scene, pose), (turned, counter_rotated(pose, rotation))))
    assert (
        float((before - after).abs().max()) < 1e-10 < float((render(turned, camera(pose)).image - before).abs().max())
    )


def test_turned_gaussians_against_the_oracle():
    """Drawn in float32, against the originals in the float64 arithmetic of the oracle."""
    scene = random_scene(60, 3, seed=9, dtype=torch.float32)
    pose, rotation = torch.as_tensor(turned_pose(0.3, -0.2), dtype=torch.float64), some_rotation(7)
    found = render(scene.rotated(rotation), camera(counter_rotated(pose, rotation))).image[0].double()
    cameras = camera(pose)
    want = reference.dense_torch(
        *(field[None].double() for field in scene.fields().values()),
        torch.ones(1, 1, 3, dtype=torch.float64),
        *(t[None] for t in (pose[None], cameras.intrinsics(), cameras.limits())),
        W,
        H,
    )
    assert -10 * float((found - want[0][0, 0]).square().mean().log10()) >= 80


def test_a_quaternion_is_its_matrix_and_turns_add_up():
    scene = random_scene(5, 3, seed=2, dtype=torch.float64)
    half = math.radians(35) / 2
    quaternion = (7 * math.cos(half), 0, 0, 7 * math.sin(half))
    cos, sin = math.cos(2 * half), math.sin(2 * half)
    matrix = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    one, other = scene.rotated(quaternion), scene.rotated(matrix)
    for name in scene.fields():
        torch.testing.assert_close(one.fields()[name], other.fields()[name])
    back = one.rotated(matrix.T)
    torch.testing.assert_close(back.means, scene.means)
    torch.testing.assert_close(back.sh, scene.sh)
    for axis in range(3):  # half turns: the real part of the quaternion is zero
        signs = torch.full((3,), -1.0, dtype=torch.float64)
        signs[axis] = 1
        torch.testing.assert_close(scene.rotated(torch.diag(signs)).means, scene.means * signs)


def test_batch_dtype_and_gradients_are_kept():
    scenes = [random_scene(6, 2, seed=seed, dtype=torch.float32) for seed in (0, 1)]
    batch = Gaussians(*(torch.stack(fields) for fields in zip(*(s.fields().values() for s in scenes))))
    batch.sh.requires_grad_()
    turned = batch.rotated(some_rotation(3))
    assert turned.is_batched and turned.dtype == torch.float32 and turned.sh.requires_grad
    torch.testing.assert_close(turned.sh[1].detach(), scenes[1].rotated(some_rotation(3)).sh)
    turned.sh.square().sum().backward()  # the rotation is orthogonal: the sum of squares stays
    torch.testing.assert_close(batch.sh.grad, 2 * batch.sh.detach())


@pytest.mark.parametrize(
    "rotation, words",
    [
        (2 * np.eye(3), "orthonormal"),
        (np.diag([1, 1, -1]), "mirroring"),
        (np.zeros(4), "zero"),
        (np.eye(4), "4, 4"),
        ("up", "numbers"),
        (np.full((3, 3), np.nan), "finite"),
        (None, "numbers"),
    ],
)
def test_what_is_no_rotation_is_refused(rotation, words):
    with pytest.raises(InputError, match=words):
        random_scene(2, 0, seed=0).rotated(rotation)
