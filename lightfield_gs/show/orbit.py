"""Pictures of a scene, of cameras and of rigs from around them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
import torch

from lightfield_gs.panels.content import content_bounds, find_subject, select, thinned
from lightfield_gs.panels.front import orbit_poses
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.axes import upright_rotation
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.show.preview import to_integers

SIZE_PX = 400, 300
MOST_GAUSSIANS = 60_000  # that are drawn: a picture of them takes a twentieth of a second on one core
MOST_CAMERAS = 100
_HALF_VIEW_DEG = 15.0
_FILLED = 0.94  # of the picture, by what it shows
_TILT_DEG = 25.0  # from which cameras are seen
_WIDEST = 1.5  # tangent of a drawn camera's half field of view at most
_LINES = 3  # pixels of a drawing for each that is shown
ENDS = np.array([[43, 108, 176], [221, 107, 32]])  # the colours of the first and the last camera or view


class SceneOrbit(NamedTuple):
    """Pictures of a scene from around it, uint8 [h, w, 3] each, and a line for each thing that they leave out."""

    frames: list[np.ndarray]
    notes: list[str]


def scene_orbit(gaussians: Gaussians, turns_deg: Sequence[float], up: str) -> SceneOrbit:
    """Draw a scene, or its subject, from around it over white; all pictures have one distance and one size.

    Args:
        gaussians: One valid set.
        turns_deg: That the cameras go to the right, 0 being in front as for Rig.frame.
        up: As for Rig.frame.
    """
    some = thinned(gaussians.detach(), MOST_GAUSSIANS)
    notes = thinning_notes(gaussians, some)
    inside = find_subject(some).inside
    if inside is not None:
        some = select(some, inside)
        notes.append("the subject alone is drawn")
    low, high = content_bounds(some).double().cpu().numpy().T
    corners = np.stack(np.meshgrid(*zip(low, high)), -1).reshape(-1, 3)
    middle, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    poses = orbit_poses(middle, radius / math.sin(math.radians(_HALF_VIEW_DEG)), turns_deg, upright_rotation(up))
    seen = corners @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
    slopes = np.abs(seen[..., :2] / seen[..., 2:]).max((0, 1))
    focal = float((_FILLED * np.array(SIZE_PX) / 2 / np.maximum(slopes, 1e-9)).min())
    frames = []
    for pose in torch.from_numpy(poses).to(some.means):
        pair = pose.new_full((1, 2), focal), pose.new_tensor([SIZE_PX]) / 2
        with torch.no_grad():
            image = render(some, Cameras(pose[None], *pair, *SIZE_PX)).image[0]
        frames.append(to_integers(image.cpu().numpy(), 8))
    return SceneOrbit(frames, notes)


def thinning_notes(gaussians: Gaussians, some: Gaussians) -> list[str]:
    """Return a line that says how many Gaussians are drawn, where they are not all."""
    return [f"{some.count} of them are drawn, larger"] if some.count < gaussians.count else []


def gradient(count: int) -> np.ndarray:
    """Return colours from the first to the last of some cameras or views, uint8 [count, 3]."""
    share = np.linspace(0, 1, count)[:, None] if count > 1 else np.zeros((1, 1))
    return (ENDS[0] + share * (ENDS[1] - ENDS[0])).round().astype(np.uint8)


def camera_orbit(cameras: Cameras, turns_deg: Sequence[float], plane: np.ndarray | None = None) -> list[np.ndarray]:
    """Draw cameras as pyramids from around them, from blue for the first to orange for the last, uint8 [h, w, 3] each.

    Pyramids have the cameras' fields of view; of models other than "pinhole" and "fisheye" a line shows the direction.

    Args:
        cameras: One set [C], C >= 1.
        turns_deg: That one who looks at them goes to the right, 0 being behind the cameras.
        plane: [4, 3], the corners of a plane that is drawn too, in world axes.
    """
    from PIL import Image, ImageDraw

    poses = cameras.world_to_camera.detach().double().cpu().numpy()
    rotations = poses[:, :3, :3]
    centres = -(rotations.mT @ poses[:, :3, 3:])[..., 0]
    ends = _pyramids(cameras, rotations, _drawn_depth(centres, plane))
    points = np.concatenate([centres[:, None], centres[:, None] + ends], 1)  # [C, 5, 3]
    corners = points.reshape(-1, 3) if plane is None else np.concatenate([points.reshape(-1, 3), plane])
    low, high = corners.min(0), corners.max(0)
    turns = orbit_poses((low + high) / 2, 0.0, turns_deg, _mean_axes(rotations), _TILT_DEG)
    flat = (corners @ turns[:, :3, :3].mT + turns[:, None, :3, 3])[..., :2]  # seen from far away
    start, end = flat.min((0, 1)), flat.max((0, 1))
    scale = float((_FILLED * np.array(SIZE_PX) / np.maximum(end - start, 1e-9)).min())
    flat = ((flat - (start + end) / 2) * scale + np.array(SIZE_PX) / 2) * _LINES
    colours = [tuple(colour) for colour in gradient(len(centres)).tolist()]
    frames = []
    for places in flat:
        image = Image.new("RGB", (SIZE_PX[0] * _LINES, SIZE_PX[1] * _LINES), "white")
        pen = ImageDraw.Draw(image)
        if plane is not None:
            pen.polygon([tuple(place) for place in places[-4:]], fill="#edf2f7", outline="#a0aec0", width=_LINES)
        for number, colour in enumerate(colours):
            tip, *rim = (tuple(place) for place in places[5 * number : 5 * number + 5])
            for corner in rim:
                pen.line([tip, corner], fill=colour, width=_LINES)
            pen.line([*rim, rim[0]], fill=colour, width=_LINES)
            pen.ellipse([value + sign * 1.5 * _LINES for sign in (-1, 1) for value in tip], fill=colour)
        frames.append(np.asarray(image.resize(SIZE_PX, Image.Resampling.BOX)))
    return frames


def _drawn_depth(centres: np.ndarray, plane: np.ndarray | None) -> float:
    """Return the depth of the drawn pyramids, scene units: a part of what is around them."""
    places = centres if plane is None else np.concatenate([centres, plane])
    return 0.15 * float(np.linalg.norm(places.max(0) - places.min(0))) or 1.0


def _pyramids(cameras: Cameras, rotations: np.ndarray, depth: float) -> np.ndarray:
    """Return the corners of each camera's picture [C, 4, 3] at a depth before it, in world axes, from its centre."""
    if cameras.model in ("pinhole", "fisheye"):
        focal = cameras.focal_px.detach().double().cpu().numpy()
        centre = cast(torch.Tensor, cameras.principal_point_px).detach().double().cpu().numpy()
    else:
        focal, centre = np.full((len(rotations), 2), math.inf), np.zeros((len(rotations), 2))
    width, height = cast(int, cameras.width_px), cast(int, cameras.height_px)
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    slopes = ((pixels - centre[:, None]) / focal[:, None]).clip(-_WIDEST, _WIDEST)
    return depth * np.concatenate([slopes, np.ones_like(slopes[..., :1])], -1) @ rotations


def _mean_axes(rotations: np.ndarray) -> np.ndarray:
    """Return a rotation [3, 3] to right, down and forward: down is the cameras' mean, forward that of the first."""
    down = rotations[:, 1].mean(0)
    if np.linalg.norm(down) < 0.1:  # cameras of all attitudes have no common one
        return rotations[0]
    down /= np.linalg.norm(down)
    forward = rotations[0, 2] - down * (down @ rotations[0, 2])
    if np.linalg.norm(forward) < 1e-3:
        return rotations[0]
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(down, forward), down, forward])
