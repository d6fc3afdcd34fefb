"""A scene known in closed form: a slanted textured wall and a ball before it, as cameras side by side see them."""

from __future__ import annotations

import functools

import numpy as np
import torch

from lightfield_gs.scene.cameras import Cameras

BALL, RADIUS = np.array([0.1, -0.05, 1.5]), 0.3
WALL_POINT, WALL_NORMAL = np.array([0, 0, 2.2]), np.array([-0.8, 0.3, 1.0])


def camera(width: int, height: int, focal: float, offset: float = 0.0) -> Cameras:
    """Return a camera `offset` to the right of the photo's, looking along z."""
    pose = torch.eye(4)[None].clone()
    pose[0, 0, 3] = -offset
    return Cameras(pose, torch.tensor([[focal, focal]]), torch.tensor([[width / 2, height / 2]]), width, height)


def view(width: int, height: int, focal: float, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colours [H, W, 3], depths [H, W] and points [H, W, 3] in the view of `camera`, float64."""
    rows, columns = np.mgrid[:height, :width] + 0.5
    rays = np.stack([(columns - width / 2) / focal, (rows - height / 2) / focal, np.ones_like(rows)], 2)
    eye = np.array([offset, 0, 0])
    wall = ((WALL_POINT - eye) @ WALL_NORMAL) / (rays @ WALL_NORMAL)
    to_ball = BALL - eye
    along, square = rays @ to_ball, (rays**2).sum(2)
    root = along**2 - square * (to_ball @ to_ball - RADIUS**2)
    ball = np.where(root > 0, (along - np.sqrt(root.clip(0))) / square, np.inf)
    depth = np.minimum(wall, ball)
    points = rays * depth[..., None] + eye
    return np.where((ball < wall)[..., None], _ball_colour(points), _wall_colour(points)), depth, points


def _wall_colour(points: np.ndarray) -> np.ndarray:
    x, y = points[..., 0], points[..., 1]
    return 0.5 + 0.3 * np.stack([np.sin(9 * x), np.sin(8 * y), np.sin(7 * (x + y))], -1)


def _ball_colour(points: np.ndarray) -> np.ndarray:
    normal = (points - BALL) / RADIUS
    return 0.5 + 0.35 * normal * [1, 1, -1]


TEXTURED = 256, 192, 224.0  # width, height and focal length of `textured`, pixels


@functools.cache
def textured(offset: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """The scene with texture that can be matched, from a camera so far to the right, and its depths; to be read."""
    colours, depth, points = view(*TEXTURED, offset)
    x, y = points[..., :1], points[..., 1:2]
    waves = np.sin(40 * x + 3 * np.sin(13 * y)) * np.sin(36 * y + 2 * np.sin(11 * x))
    return (colours + 0.25 * waves).clip(0, 1).astype(np.float32), depth.astype(np.float32)
