"""Cameras and view maps that no rig and no lens make, for the tests of the method `sorted`."""

from __future__ import annotations

import math

import numpy as np
import torch
from rasterizer_cases import turned_pose

from lightfield_gs import Cameras, Panel, reference
from lightfield_gs.scene.gaussians import Gaussians


def toe_in(panel: Panel, count: int, span: float = 0.9, focal: float = 1.4) -> Cameras:
    """Cameras on an arc that all look at the scene, no two with the same focal length or principal point."""
    size = focal * max(40, panel.height_px)
    angles = np.linspace(-span / 2, span / 2, count) if count > 1 else np.zeros(1)
    poses = np.stack([turned_pose(angle, 0.1 * math.sin(3 * angle)) for angle in angles])
    grow = 1 + 0.1 * np.sin(np.arange(count))
    focals = np.stack([size * grow, 1.1 * size * grow], 1)
    centres = np.stack([0.5 * panel.width_px + 3 * np.cos(np.arange(count)), np.full(count, 0.47 * panel.height_px)], 1)
    return Cameras(*(torch.from_numpy(array) for array in (poses, focals, centres)), panel.width_px, panel.height_px)


def random_map(panel: Panel, views: int, seed: int, hidden: float = 0.1) -> np.ndarray:
    """Return a random view for every sub-pixel; some sub-pixels show nothing."""
    random = np.random.default_rng(seed)
    table = random.integers(0, views, (panel.height_px, panel.width_px, 3), np.int32)
    table[random.random(table.shape) < hidden] = -1
    return table


def oracle(gaussians: Gaussians, cameras: Cameras, table: np.ndarray, background) -> tuple[np.ndarray, np.ndarray]:
    """The image [H, W, 3] and its margins, one camera at a time."""
    image = np.broadcast_to(np.asarray(background, np.float64), table.shape).copy()
    margins = np.ones(table.shape)
    for view in np.unique(table[table >= 0]):
        where = np.nonzero(table == view)
        image[where], margins[where] = reference.pixel_colours(
            gaussians, cameras, int(view), *where, background=background, return_margin=True
        )
    return image, margins
