"""Captures by rolling shutters: rows that were read one by one, read from a transforms.json, drawn and fitted."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from capture_scene import said
from fit_scene import known_cameras, known_scene
from PIL import Image

from lightfield_gs import Cameras, InputError, fit, render
from lightfield_gs.fitting.image_optimizers import apply_twists, twist_gradients
from lightfield_gs.fitting.posed_images import Normalization, PosedImages
from lightfield_gs.io.captures.capture import read_capture
from lightfield_gs.rasterizer.image_render import ImageBuffers
from lightfield_gs.rasterizer.workspace import GradientRequest

WIDTH, HEIGHT, SECONDS = 48, 36, 0.03
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def _rotation(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return torch.linalg.matrix_exp(torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]).double()).numpy()


def _write(folder: Path, count: int = 8, motion: float = 1.0, height: int = HEIGHT) -> Path:
    """Photographs of known_scene() whose rows are drawn by cameras of their own, as the fields of the file say."""
    scene, cameras = known_scene(), known_cameras(count, WIDTH, height)
    generator, frames, middles = np.random.default_rng(2), [], (np.arange(height) + 0.5) / height - 0.5
    (folder / "images").mkdir(parents=True)
    for index in range(count):
        to_world = np.linalg.inv(cameras.world_to_camera[index].double().numpy()) @ OPENGL
        turn, speed = motion * generator.normal(size=(2, 3)) * [[3.0], [5.0]]  # radians and units a second
        poses = []
        for time in middles * SECONDS:
            moved = to_world.copy()
            moved[:3, :3] = to_world[:3, :3] @ _rotation(turn * time)
            moved[:3, 3] += to_world[:3, :3] @ speed * time
            poses.append(np.linalg.inv(moved @ OPENGL))
        at_rows = Cameras(
            torch.tensor(np.stack(poses)).float(),
            *(t[:1].expand(height, 2).contiguous() for t in (cameras.focal_px, cameras.principal_point_px)),
            WIDTH,
            height,
        )
        rows = render(scene, at_rows, background=(0.0, 0.0, 0.0)).image.diagonal(dim1=0, dim2=1).permute(2, 0, 1)
        pixels = (255 * rows.clamp(0, 1)).round().byte().numpy()
        Image.fromarray(np.ascontiguousarray(pixels)).save(folder / f"images/{index}.png")
        velocities = {"camera_angular_velocity": turn.tolist(), "camera_linear_velocity": speed.tolist()}
        frames.append({"file_path": f"images/{index}.png", "transform_matrix": to_world.tolist(), **velocities})
    (fx, fy), (cx, cy) = cameras.focal_px[0].tolist(), cameras.principal_point_px[0].tolist()
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": WIDTH, "h": height}
    top = {**lens, "rolling_shutter_time": SECONDS, "ply_file_path": "points.ply"}
    (folder / "transforms.json").write_text(json.dumps({**top, "frames": frames}))
    header = ["ply", "format ascii 1.0", "element vertex 150", *(f"property float {key}" for key in "xyz")]
    points = (" ".join(f"{value:.6f}" for value in mean) for mean in scene.means[:150].tolist())
    (folder / "points.ply").write_text("\n".join([*header, "end_header", *points, ""]))
    return folder


def _change(folder: Path, **fields) -> Path:
    """Change fields at the top of the capture's file; None takes one out."""
    file = folder / "transforms.json"
    data = json.loads(file.read_text()) | fields
    file.write_text(json.dumps({key: value for key, value in data.items() if value is not None}))
    return folder


def _load(folder: Path) -> PosedImages:
    capture = read_capture(folder)
    indices = range(len(capture.names))
    return PosedImages.load(capture, indices, Normalization((0.1, -0.2, 0.3), 1.6), "cpu", indices)


def _psnr_db(images: PosedImages) -> float:
    """Of the scene that was photographed."""
    scene, middle = known_scene(), torch.tensor([0.1, -0.2, 0.3])
    scene = replace(scene, means=(scene.means - middle) / 1.6, scales=scene.scales / 1.6)
    drawn = render(scene, images.cameras(), background=(0.0, 0.0, 0.0)).image.clamp(0, 1)
    return -10 * math.log10(float((drawn - images.photos / 255).square().mean()))


def test_the_scene_that_was_photographed_is_the_photographs(tmp_path):
    """Signs, axes and times of the file's fields: any wrong one is worse than a camera at rest."""
    images = _load(_write(tmp_path, 4))
    assert images.world_to_camera.shape == (4, 6, 4) and images.rolling_shutter == "top_to_bottom"
    rolling = _psnr_db(images)
    assert rolling > 38
    _change(tmp_path, rolling_shutter_time=None)
    assert _psnr_db(_load(tmp_path)) < rolling - 12


def test_smaller_photographs_are_read_at_their_own_pace(tmp_path):
    """Photographs of two sizes are drawn as the largest, and the part that is drawn has the right times."""
    _write(tmp_path / "tall", 2, 0.5)
    low = _write(tmp_path / "low", 2, 0.5, HEIGHT - 12)
    for index in range(2):
        (low / f"images/{index}.png").rename(tmp_path / f"tall/images/low{index}.png")
    data = json.loads((low / "transforms.json").read_text())
    own = {key: data[key] for key in ("h", "cx", "cy", "fl_x", "fl_y")}
    tall = json.loads((tmp_path / "tall/transforms.json").read_text())
    frames = [{**frame, **own, "file_path": f"images/low{index}.png"} for index, frame in enumerate(data["frames"])]
    images = _load(_change(tmp_path / "tall", frames=tall["frames"] + frames))
    scene, black = known_scene(), torch.zeros(1, 3)
    middle = torch.tensor([0.1, -0.2, 0.3])
    scene = replace(scene, means=(scene.means - middle) / 1.6, scales=scene.scales / 1.6)
    for index, (width, height) in enumerate(images.sizes):
        job = images.render_job(
            scene, torch.tensor([index]), images.world_to_camera, black, False, size_px=(width, height)
        )
        error = job.draw().image[0, 0].clamp(0, 1) - images.photos[index, :height, :width] / 255
        assert -10 * math.log10(float(error.square().mean())) > 38, images.names[index]


def test_a_refined_pose_carries_its_motion_along(tmp_path):
    """The gradient of six numbers of a camera is that of the image, whose whole path moves with the first pose."""
    images, scene = _load(_write(tmp_path, 1)), known_scene(60, 1).to(torch.float64)
    poses, weights = images.world_to_camera.double(), torch.rand(1, 1, HEIGHT, WIDTH, 3).double()
    images = replace(images, intrinsics=images.intrinsics.double(), limits=images.limits.double())

    def job_at(twists: torch.Tensor):
        black = torch.zeros(1, 3).double()
        return images.render_job(scene, torch.tensor([0]), apply_twists(poses, twists), black, False)

    job = job_at(torch.zeros(1, 6).double())
    images_found = job.draw()
    gradients = job.backward(images_found, ImageBuffers(weights, None, None), GradientRequest(cameras=True))
    found = twist_gradients(poses, gradients.cameras)[0]
    for number in range(6):
        step = torch.zeros(1, 6).double()
        step[0, number] = 1e-6
        ahead, behind = (float((job_at(sign * step).draw().image * weights).sum()) for sign in (1, -1))
        assert float(found[number]) == pytest.approx((ahead - behind) / 2e-6, rel=1e-3, abs=1e-3)


def test_a_fit_by_rolling_shutters_is_better_than_one_by_cameras_at_rest(tmp_path):
    folder, scores = _write(tmp_path / "capture"), []
    for seconds in (SECONDS, None):
        _change(folder, rolling_shutter_time=seconds)
        result = fit(folder, steps=200, cap_max=400, device="cpu", test_every=4, progress=False)
        scores.append(result.scores.mean_psnr_db)
    assert scores[0] > scores[1] + 2


def test_fields_of_readouts_are_said_or_refused(tmp_path):
    folder = _write(tmp_path / "capture", 2)
    assert "2 of 2 photographs are drawn by rolling shutters, read from top to bottom in 30 ms" in said(folder)[1]
    with pytest.raises(InputError, match="rolling_shutter_time, seconds"):
        read_capture(_change(folder, rolling_shutter_time=33))
    _change(folder, rolling_shutter_time=SECONDS)
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    with pytest.raises(InputError, match="camera_angular_velocity: expected 3 numbers"):
        read_capture(_change(folder, frames=[{**frame, "camera_angular_velocity": 1} for frame in frames]))
    with pytest.raises(InputError, match="in radians a second"):
        read_capture(_change(folder, frames=[{**frame, "camera_angular_velocity": [0, 90, 0]} for frame in frames]))
    still = [{key: frame[key] for key in ("file_path", "transform_matrix")} for frame in frames]
    capture, words = said(_change(folder, frames=still))
    assert capture.readouts is None and "count as taken at one instant" in words
