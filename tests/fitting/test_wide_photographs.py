"""Fits of photographs by fisheyes and of whole rounds: the scene is drawn by the lens itself, also behind it."""

import json
import math

import numpy as np
import torch
from capture_scene import write_model
from PIL import Image

from lightfield_gs import Cameras, Gaussians, fit, render
from lightfield_gs.fitting.posed_images import Normalization, PosedImages
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.io.captures.pinhole import pose_matrix

SIDE, FOCAL = 64, 17.0  # 64 / 2 / 17 radians: 108 degrees from the axis at the edge
BEND = (0.02, -0.004, 0.001, -0.0001)


def _scene(count: int = 1500) -> Gaussians:
    """A sphere of coloured Gaussians round the cameras."""
    generator = torch.Generator().manual_seed(1)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1) * 3
    colours = 0.5 + 0.5 * torch.sin(means * 2)
    sh = (colours - 0.5)[:, None] / 0.28209479177387814
    quaternions = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    return Gaussians(means, quaternions, torch.full((count, 3), 0.12), torch.full((count,), 0.9), sh)


def _write(folder, photographs: int = 7) -> tuple[Gaussians, list[np.ndarray]]:
    """A capture of OPENCV_FISHEYE in a folder, drawn four times as fine and then reduced; and its poses."""
    scene, images, poses = _scene(), [], []
    (folder / "images").mkdir(parents=True)
    for index in range(photographs):
        turn = 0.7 * index
        quaternion = np.array([math.cos(turn / 2), 0, math.sin(turn / 2), 0])
        translation = np.array([0.3 * math.sin(2 * index), 0.2 * math.cos(3 * index), 0.1 * index - 0.3])
        pose = pose_matrix(quaternion, translation)
        camera = Cameras(
            torch.tensor(pose)[None].float(),
            torch.full((1, 2), FOCAL),
            torch.full((1, 2), SIDE / 2),
            SIDE,
            SIDE,
            model="fisheye",
            distortion=torch.tensor([BEND]),
            widest_deg=160,
        )
        picture = render(scene, camera, background=(0.0, 0.0, 0.0)).image[0].clamp(0, 1)
        Image.fromarray((255 * picture).round().byte().numpy()).save(folder / f"images/{index:03}.png")
        images.append((f"{index:03}.png", 1, quaternion, translation))
        poses.append(pose)
    cameras = [(1, "OPENCV_FISHEYE", SIDE, SIDE, [FOCAL, FOCAL, SIDE / 2, SIDE / 2, *BEND])]
    points = [(mean, (128, 128, 128)) for mean in scene.means[::3].tolist()]
    write_model(folder / "sparse/0", "txt", cameras, images, points)
    return scene, poses


def test_photographs_beyond_a_half_sphere_are_drawn_where_they_were_seen(tmp_path):
    """The scene that was photographed, drawn by what is read, is the photographs, but for the resampling."""
    scene, _ = _write(tmp_path, 3)
    capture = read_capture(tmp_path)
    assert capture.model == "fisheye"
    images = PosedImages.load(capture, [0, 1, 2], Normalization((0.0, 0.0, 0.0), 1.0), "cpu", range(3))
    assert images.widest_deg > 108
    drawn = render(scene, images.cameras(), background=(0.0, 0.0, 0.0)).image
    counts = 1.0 if images.weights is None else images.weights[..., None] / 255
    errors = ((drawn - images.photos / 255) * counts).square().mean()
    assert -10 * math.log10(errors) > 30


def test_a_fit_of_fisheyes_finds_the_scene(tmp_path):
    _write(tmp_path)
    result = fit(tmp_path, steps=300, cap_max=1500, device="cpu", test_every=7, progress=False)
    assert result.scores.mean_psnr_db > 18 and result.gaussians.means.norm(dim=1).median() > 2


def test_rounds_are_drawn_as_two_halves_where_they_were_seen(tmp_path):
    """What a transforms.json with equirectangular photographs has, drawn by both halves, is the photographs."""
    scene, frames = _scene(), []
    for index in range(2):
        turn = 0.9 * index
        pose = pose_matrix([math.cos(turn / 2), 0, math.sin(turn / 2), 0], [0.2 * index, 0.1, -0.2])
        camera = Cameras.equirectangular(torch.tensor(pose)[None].float(), 128)
        picture = render(scene, camera, background=(0.0, 0.0, 0.0)).image[0].clamp(0, 1)
        Image.fromarray((255 * picture).round().byte().numpy()).save(tmp_path / f"{index}.png")
        to_world = np.linalg.inv(pose) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"{index}.png", "transform_matrix": to_world.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps({"camera_model": "EQUIRECTANGULAR", "frames": frames}))
    capture = read_capture(tmp_path)
    assert capture.names == ["0.png", "0.png (behind)", "1.png", "1.png (behind)"]
    images = PosedImages.load(capture, [0, 1, 2, 3], Normalization((0.0, 0.0, 0.0), 1.0), "cpu", range(4))
    drawn = render(scene, images.cameras(), background=(0.0, 0.0, 0.0)).image
    assert (drawn.clamp(0, 1) - images.photos / 255).abs().max() < 0.01
    fitted = fit(capture, steps=20, cap_max=500, device="cpu", test_every=None, progress=False)
    assert fitted.gaussians.count > 0
