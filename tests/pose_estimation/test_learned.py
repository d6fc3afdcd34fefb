"""Poses by a network where COLMAP fails: a module that knows the cameras stands in for it."""

import sys
import types
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from capture_scene import said
from command_line import complaint, run
from film_scene import FOCAL_PX, HEIGHT, WIDTH, arc, photographs, wall
from PIL import Image
from pycolmap_stand_in import Model, stand_in

ANGLES_DEG = np.array([-9.0, -3, 0, 4, 10])
SMALL = 4  # times smaller are the pictures that the network sees


@pytest.fixture
def folder(tmp_path) -> Path:
    """Photographs of a flat wall, z = 0."""
    (tmp_path / "in").mkdir()
    for index, picture in enumerate(photographs(wall(0.0), arc(ANGLES_DEG))):
        Image.fromarray(picture).save(tmp_path / f"in/{index}.png")
    return tmp_path / "in"


def _depths(poses: np.ndarray) -> np.ndarray:
    """Depth maps of the wall, [C,h,w]."""
    x, y = (np.arange(WIDTH // SMALL) + 0.5) * SMALL, (np.arange(HEIGHT // SMALL) + 0.5) * SMALL
    rays = np.stack(
        [*np.meshgrid((x - WIDTH / 2) / FOCAL_PX, (y - HEIGHT / 2) / FOCAL_PX), np.ones((len(y), len(x)))], -1
    )
    towards = np.einsum("cji,hwj->chwi", poses[:, :3, :3], rays)[..., 2]  # z of the rays in the world
    centres = -(poses[:, :3, :3].swapaxes(1, 2) @ poses[:, :3, 3:])[:, 2, 0]
    return -centres[:, None, None] / towards


@pytest.fixture
def network(monkeypatch) -> SimpleNamespace:
    """Stands in for the package depth_anything_3; records its input."""
    given = SimpleNamespace(names=[], sizes=[])
    poses = arc(ANGLES_DEG)

    def inference(pictures, process_res):
        assert all(picture.dtype == np.uint8 for picture in pictures) and process_res == 504
        given.sizes += [picture.shape for picture in pictures]
        focal = FOCAL_PX / SMALL * np.array([0.9, 1, 1, 1, 1.2])  # as estimated for each picture
        matrices = np.array([[[f, 0, WIDTH / 2 / SMALL], [0, f, HEIGHT / 2 / SMALL], [0, 0, 1]] for f in focal])
        sure = np.ones((len(poses), HEIGHT // SMALL, WIDTH // SMALL))
        return SimpleNamespace(extrinsics=poses[:, :3], intrinsics=matrices, depth=_depths(poses), conf=sure)

    def from_pretrained(name):
        given.names.append(name)
        return SimpleNamespace(to=lambda device: SimpleNamespace(inference=inference))

    api = types.ModuleType("depth_anything_3.api")
    api.DepthAnything3 = SimpleNamespace(from_pretrained=from_pretrained)
    monkeypatch.setitem(sys.modules, "depth_anything_3", types.ModuleType("depth_anything_3"))
    monkeypatch.setitem(sys.modules, "depth_anything_3.api", api)
    return given


@pytest.mark.parametrize("found", [{}, {0: Model(2)}])
def test_a_network_poses_what_colmap_does_not(folder, network, found, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", stand_in(found))
    command = f"fit {folder} -o {tmp_path / 's.ply'} --sfm --steps 1 --gaussians 3 --device cpu"
    out = run(capsys, f"{command} --pose-model DA3-BASE")
    assert network.names == ["depth-anything/DA3-BASE"] and network.sizes == [(HEIGHT, WIDTH, 3)] * 5
    assert "DA3-BASE poses them instead" in out and "may be off by some pixels: --poses refines them" in out
    capture, _ = said(tmp_path / "s.fit/sfm", images=folder)
    np.testing.assert_allclose(capture.world_to_camera, arc(ANGLES_DEG), atol=1e-12)
    np.testing.assert_allclose(capture.intrinsics, [[FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2]] * 5)
    assert len(capture.points) > 10_000 and np.abs(capture.points[:, 2]).max() < 1e-9
    assert np.ptp(capture.colours.astype(int), 0).min() > 100


def test_colmap_comes_first(folder, network, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", stand_in({0: Model(5)}))
    for path in sorted(folder.iterdir()):  # the names and the size of the stand-in's model
        Image.open(path).resize((96, 72)).save(folder / f"{int(path.stem):03d}.png")
        path.unlink()
    command = f"fit {folder} -o {tmp_path / 's.ply'} --sfm --steps 1 --gaussians 3 --device cpu"
    out = run(capsys, f"{command} --pose-model DA3-BASE")
    assert "posed 5 of 5 photographs" in out and network.sizes == []


def test_what_a_network_takes_is_named(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", stand_in({}))
    command = f"fit {folder} -o {tmp_path / 's.ply'} --sfm --device cpu"
    assert "pose_model: expected one of" in complaint(capsys, f"{command} --pose-model VGGT").replace(
        "--pose-model", "pose_model"
    )
    monkeypatch.setitem(sys.modules, "depth_anything_3", None)
    words = complaint(capsys, f"{command} --pose-model DA3-BASE")
    assert "takes the package depth_anything_3" in words and words.rstrip().endswith(
        "pip install 'lightfield-gs[poses]'"
    )
