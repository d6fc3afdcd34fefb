"""Gaussians and cameras used like tensors: indexed, joined, copied, saved."""

import json
import subprocess
import sys

import numpy as np
import pytest
import torch

from lightfield_gs import Cameras, Gaussians, InputError
from lightfield_gs.io.captures.dataparser import read_dataparser_transform

K = [[30.0, 0.0, 8.0], [0.0, 31.0, 6.0], [0.0, 0.0, 1.0]]


def scene(*lead: int) -> Gaussians:
    generator = torch.Generator().manual_seed(1)
    shapes = ((3,), (4,), (3,), (), (4, 3))
    means, quaternions, scales, opacities, sh = (torch.rand(*lead, *own, generator=generator) + 0.1 for own in shapes)
    return Gaussians(means, quaternions, scales, opacities, sh, (1.0, 2.0, 3.0))


def turned(count: int) -> torch.Tensor:
    """Poses of rotations about y, and other places."""
    poses = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    angles = torch.arange(count, dtype=torch.float64) / 5
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = (
        angles.cos(),
        angles.sin(),
        -angles.sin(),
        angles.cos(),
    )
    poses[:, :3, 3] = torch.arange(3 * count).view(count, 3) / 7
    return poses


@pytest.mark.parametrize("lead", [(6,), (2, 6)])
@pytest.mark.parametrize(
    "rows",
    [2, -1, slice(1, None, 2), slice(None, None, -1), [4, 0, 0], np.array([5, -6]), torch.tensor([1]), [],
     [True, False] * 3, np.arange(6) > 3],
)  # fmt: skip
def test_rows_are_those_of_every_tensor(lead, rows):
    whole, numbers = scene(*lead), torch.arange(6)
    chosen = whole[rows]
    expected = numbers.numpy()[np.array(rows, dtype=None if len(rows) else int)] if isinstance(rows, list) else (
        numbers.numpy()[rows]
    )  # fmt: skip
    expected = torch.from_numpy(np.atleast_1d(expected).copy())
    assert len(chosen) == len(expected) and chosen.origin == whole.origin
    for name, tensor in whole.fields().items():
        assert torch.equal(chosen.fields()[name], tensor.index_select(len(lead) - 1, expected)), name


def test_cameras_are_chosen_and_joined_with_all_that_they_have():
    given = turned(5), torch.full((5, 2), 30.0), torch.rand(5, 2)
    cameras = Cameras(*given, 16, 12, model="fisheye", distortion=torch.rand(5, 4) / 50)
    parts = list(cameras)
    assert [len(part) for part in parts] == [1] * 5
    joined = Cameras.cat(parts)
    assert (joined.model, joined.widest_deg) == (cameras.model, cameras.widest_deg)
    for name, tensor in cameras.tensors().items():
        assert torch.equal(joined.tensors()[name], tensor), name


def test_gradients_pass_through_rows_copies_and_sums():
    leaf = scene(6).requires_grad_()
    Gaussians.cat([leaf[[1, 1]], leaf.clone()[:2]]).means.sum().backward()
    assert leaf.means.grad.sum(1).tolist() == [3, 9, 0, 0, 0, 0]
    assert not any(tensor.requires_grad for tensor in leaf.detach().cpu().tensors().values())


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: scene(6)[6], IndexError, r"expected rows of -6..5, got 6"),
        (lambda: scene(6)[[True]], IndexError, "mask of 6 rows, got one of 1"),
        (lambda: scene(6)["a"], InputError, "a number, a slice"),
        (lambda: scene(6)[[0.5]], InputError, "torch.float32"),
        (lambda: scene(6)[[[1]]], InputError, "a number, a slice"),
        (lambda: Gaussians.cat([]), InputError, "a row of Gaussians"),
        (lambda: Gaussians.cat([scene(2), scene(2).to(torch.float64)]), InputError, "means of part 1: .*float64"),
        (lambda: Gaussians.cat([scene(2), scene(1, 2)]), InputError, "part 1"),
        (lambda: Cameras.from_K(K, turned(2)[:, :2], 16, 12), InputError, r"or 3 rows in place of 4, got \[2, 2, 4\]"),
        (lambda: Cameras.from_K("a", turned(2), 16, 12), InputError, "K: expected a tensor"),
    ],
)
def test_others_are_refused(call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_cameras_of_matrices_are_those_of_opencv_and_opengl(tmp_path):
    poses = turned(3)
    cameras = Cameras.from_K(K, poses[:, :3], 16, 12)
    assert torch.equal(cameras.world_to_camera, poses)
    assert cameras.intrinsics().tolist() == [[30.0, 31.0, 8.0, 6.0]] * 3
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    camera_to_world = torch.linalg.inv(poses) @ flip
    found = Cameras.from_opengl(camera_to_world.numpy(), K, 16, 12)
    torch.testing.assert_close(found.world_to_camera, poses, rtol=0, atol=1e-12)

    # In nerfstudio's world the same point of the scene is at the same pixel, and depths have its scale
    moved = {"transform": [[0, 0, 1, 2], [1, 0, 0, 3], [0, 1, 0, 4]], "scale": 0.5}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(moved))
    exported = Cameras.from_opengl(camera_to_world, K, 16, 12, dataparser=tmp_path / "dataparser_transforms.json")
    point = np.array([0.3, -0.2, 5.0])
    elsewhere = read_dataparser_transform(tmp_path / "dataparser_transforms.json").points(point)
    before, after = (
        rows.world_to_camera[:, :3, :3].numpy() @ place + rows.world_to_camera[:, :3, 3].numpy()
        for rows, place in ((found, point), (exported, elsewhere))
    )
    np.testing.assert_allclose(after, 0.5 * before, atol=1e-12)


def test_torch_load_reads_them_by_its_safe_way(tmp_path):
    cameras = Cameras.from_K(K, turned(3), 16, 12)
    torch.save({"scene": scene(6), "cameras": cameras}, tmp_path / "both.pt")
    code = (
        "import sys, torch, lightfield_gs as lf\n"
        "lf.Cameras\n"
        "both = torch.load(sys.argv[1], weights_only=True)\n"
        "print(len(both['scene']), both['scene'].origin, len(both['cameras']), both['cameras'].width_px)"
    )
    run = subprocess.run([sys.executable, "-c", code, tmp_path / "both.pt"], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "6 (1.0, 2.0, 3.0) 3 16"
