"""Scenes with more than their subject, for the tests of framing."""

import numpy as np
import torch
from panel_cases import plain_panel

from lightfield_gs import Gaussians

PANEL = plain_panel(160, 80, cone_deg=20, viewing_distance_mm=600, pixel_pitch_mm=1.8)
UPRIGHT = np.eye(4)


def blobs(places, size=0.02) -> Gaussians:
    means = torch.tensor(np.asarray(places), dtype=torch.float32)
    count = len(means)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.full((count, 3), size),
        torch.full((count,), 0.9),
        torch.zeros(count, 1, 3),
    )


def joined(*scenes: Gaussians) -> Gaussians:
    return Gaussians(*(torch.cat(fields) for fields in zip(*(scene.fields().values() for scene in scenes))))


def thing(centre=(0, 0, 0), count=1500) -> Gaussians:
    """Return a plate, 0.8 wide and 1.2 high."""
    random = np.random.default_rng(1)
    return blobs(random.uniform(-1, 1, (count, 3)) * [0.4, 0.6, 0.03] + centre)


def directions(count: int, seed: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def floaters(count: int, near: float, far: float) -> Gaussians:
    random = np.random.default_rng(2)
    return blobs(directions(count, 2) * np.exp(random.uniform(np.log(near), np.log(far), (count, 1))), 0.05)


def room(half=(3.0, 1.5, 3.0), count=6000, faces=range(6), turn=None) -> Gaussians:
    random, walls = np.random.default_rng(3), []
    for face in faces:
        places = random.uniform(-1, 1, (count // 6, 3))
        places[:, face // 2] = 2 * (face % 2) - 1
        walls.append(places * half)
    return blobs(np.concatenate(walls) @ (np.eye(3) if turn is None else turn).T, 0.12)
