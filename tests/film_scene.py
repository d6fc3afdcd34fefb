"""Films and photographs of a wall with hills, by a camera that walks along an arc."""

from pathlib import Path

import av
import numpy as np
import torch
from scipy import ndimage

import lightfield_gs as lf

WIDTH, HEIGHT, FOCAL_PX = 480, 360, 520.0
DISTANCE = 3.0


def wall(hills: float = 0.08, count: int = 20_000) -> lf.Gaussians:
    """A wall with steps and hills of this height, of flat Gaussians of random colours and many sizes."""
    random = np.random.default_rng(0)
    x, y = random.uniform(-2, 2, (2, count))
    z = hills * np.sin(1.7 * x) * np.cos(2.1 * y) + hills / 2 * np.sign(np.sin(3 * x + 1) * np.sin(2.5 * y))
    size = np.exp(random.uniform(np.log(0.01), np.log(0.06), count))
    fields = {
        "means": np.stack([x, y, z], 1),
        "scales": np.stack([size, size, 0.3 * size], 1),
        "quaternions": np.tile([1.0, 0, 0, 0], (count, 1)),
        "opacities": np.full(count, 0.97),
        "sh": random.uniform(-1.7, 1.7, (count, 1, 3)),
    }
    return lf.Gaussians(**{name: torch.tensor(values, dtype=torch.float32) for name, values in fields.items()})


def arc(angles_deg: np.ndarray) -> np.ndarray:
    """World to camera [C,4,4] of cameras on an arc, which look at the middle of the wall."""
    angles = np.radians(angles_deg)
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(angles)
    poses[:, 0, 2], poses[:, 2, 0] = np.sin(angles), -np.sin(angles)
    poses[:, 2, 3] = DISTANCE
    return poses


def photographs(scene: lf.Gaussians, poses: np.ndarray) -> np.ndarray:
    """Photographs uint8 [C,HEIGHT,WIDTH,3] by these cameras."""
    ones = torch.ones(len(poses), 2, dtype=torch.float64)
    centre = ones * torch.tensor([WIDTH / 2, HEIGHT / 2], dtype=torch.float64)
    cameras = lf.Cameras(torch.tensor(poses), ones * FOCAL_PX, centre, WIDTH, HEIGHT)
    images = lf.render(scene, cameras, background=(0.2, 0.3, 0.4)).image
    return images.clamp(0, 1).mul(255).round().byte().numpy()


def shaken(picture: np.ndarray, length_px: int) -> np.ndarray:
    """A picture that a hand's motion blurs along a row."""
    return ndimage.uniform_filter1d(picture, length_px, axis=1)


def write_film(path: Path, pictures: np.ndarray, fps: int = 30) -> Path:
    """Write frames uint8 [N,H,W,3] as H.264 of a good quality."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "12", "preset": "veryfast"})
        stream.width, stream.height, stream.pix_fmt = pictures.shape[2], pictures.shape[1], "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    return path
