"""A capture on disk of the known scene: photographs as a fit reads them, a transforms.json, and points."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from fit_scene import known_cameras, known_scene, photograph_scene
from PIL import Image


def write_capture(folder: Path, count: int = 8, points: int = 150, masked: bool = False) -> Path:
    """`count` photographs 48 x 32 of known_scene() and some of its centres; the folder. masked: the left third of every
    photograph is black in its mask."""
    scene, cameras = known_scene(), known_cameras(count)
    (folder / "images").mkdir(parents=True)
    images = photograph_scene(scene, cameras)
    frames = []
    for name, photo, pose in zip(images.names, images.photos.numpy(), cameras.world_to_camera.double().numpy()):
        Image.fromarray(photo).save(folder / "images" / name)
        camera_to_world = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's axes
        frames.append({"file_path": f"images/{name}", "transform_matrix": camera_to_world.tolist()})
    if masked:
        (folder / "masks").mkdir()
        mask = np.full(images.photos.shape[1:3], 255, np.uint8)
        mask[:, : mask.shape[1] // 3] = 0
        for name in images.names:
            Image.fromarray(mask).save(folder / "masks" / name)
    width, height = cameras.width_px, cameras.height_px
    (fx, fy), (cx, cy) = cameras.focal_px[0].tolist(), cameras.principal_point_px[0].tolist()
    lens = {"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": width, "h": height}
    (folder / "transforms.json").write_text(json.dumps({**lens, "ply_file_path": "points.ply", "frames": frames}))
    _write_points(folder / "points.ply", scene.means[:points].double().numpy())
    return folder


def _write_points(path: Path, points: np.ndarray) -> None:
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property float {key}" for key in "xyz")]
    rows = [" ".join(f"{value:.6f}" for value in point) for point in points]
    path.write_text("\n".join([*header, "end_header", *rows]) + "\n")
