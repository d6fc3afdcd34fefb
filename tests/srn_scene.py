"""A small synthetic object on disk, in SRN layout."""

from pathlib import Path

import numpy as np
from PIL import Image

WIDTH, HEIGHT, FOCAL = 64, 48, 70.0


def look_at(azimuth_deg: float, elevation_deg: float, distance: float = 1.3) -> np.ndarray:
    """Camera-to-world matrix of an upright camera that looks at the origin; world y is up, OpenCV camera axes."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    back = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    forward = -back
    right = np.cross(forward, (0, 1, 0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, distance * back], axis=1)
    return pose


def write_object(folder: Path, angles=((0, 0), (-15, 0), (15, 0), (0, 6)), suffix: str = ".png", seed: int = 0) -> None:
    """Write one object: three coloured balls about the origin, drawn as discs, nearest last, seen from `angles`."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-0.12, 0.12, (3, 3))
    centres[0] = 0
    colours = rng.integers(40, 220, (3, 3))
    for part in ("rgb", "pose"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    for index, (azimuth, elevation) in enumerate(angles):
        pose = look_at(azimuth, elevation)
        image = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
        in_camera = (centres - pose[:3, 3]) @ pose[:3, :3]
        for place in np.argsort(-in_camera[:, 2]):
            x, y, z = in_camera[place]
            distance = np.hypot(columns - FOCAL * x / z - WIDTH / 2, rows - FOCAL * y / z - HEIGHT / 2)
            image[distance < FOCAL * 0.15 / z] = (*colours[place], 255)
        picture = Image.fromarray(image)
        if suffix == ".jpg":
            white = Image.new("RGBA", picture.size, "white")
            white.alpha_composite(picture)
            picture = white.convert("RGB")
        picture.save(folder / "rgb" / f"{index:06d}{suffix}", **({"lossless": True} if suffix == ".webp" else {}))
        np.savetxt(folder / "pose" / f"{index:06d}.txt", pose.reshape(1, 16))
    (folder / "intrinsics.txt").write_text(f"{FOCAL} {WIDTH / 2} {HEIGHT / 2} 0.\n0. 0. 0.\n1.\n{HEIGHT} {WIDTH}\n")
