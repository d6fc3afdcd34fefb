"""The front of a scene that comes without cameras: the side that shows most."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.panels.content import content_bounds, find_subject, select, thinned
from lightfield_gs.panels.visibility import check_single, degree_zero
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.axes import orbit_rotation, upright_rotation
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians


@dataclass(frozen=True)
class FrontConstants:
    """How the sides are looked at. All are chosen by hand; tests/panels/test_front.py has the scenes."""

    step_deg: int = 15  # between the sides
    size_px: int = 160
    field_of_view_deg: float = 30.0
    least: int = 1000  # Gaussians, fewer of which show more on one side than on another by chance
    most: int = 100_000  # Gaussians that are drawn
    levels: int = 8  # of red, green and blue each, by which colours are told apart
    opaque: float = 0.9  # alpha from which on a pixel shows the scene, and no fog before its background
    detail: float = 0.05  # difference of neighbouring pixels, of the sum of red, green and blue, from which on it shows
    gain: float = 1.15  # how much more another side must show than the file's own, and those next to it
    alike: float = 0.97  # of the most that a side shows, from which on the side of the largest picture is taken


_CONSTANTS = FrontConstants()


def find_front(gaussians: Gaussians, up: str) -> float:
    """Return the turn in degrees, above -180 to 180, to the side of a scene that shows most; see Rig.frame's turn_deg.

    A side shows as much as its picture has of detail: the pixels that differ from their neighbours, times the entropy
    of the colours. This is the viewpoint entropy of Vázquez et al. ("Viewpoint selection using viewpoint entropy",
    2001), of colours in place of faces. Fronts have more of it than most sides and backs, and fog has none. 0 unless
    another side shows clearly more, and for scenes of few Gaussians.

    Args:
        gaussians: One set.
        up: As in Rig.frame.

    Raises:
        InputError: `gaussians` is a batch.
    """
    check_single(gaussians)
    found = find_subject(gaussians.detach())
    subject = degree_zero(gaussians if found.inside is None else select(gaussians, found.inside))
    if subject.count < _CONSTANTS.least:
        return 0.0
    subject = thinned(subject, _CONSTANTS.most)
    turns = range(0, 360, _CONSTANTS.step_deg)
    shown = [_shown(picture) for picture in _pictures(subject, turns, upright_rotation(up))]
    details = [one.detail for one in shown]
    most = max(details)
    if most <= _CONSTANTS.gain * max(details[0], details[1], details[-1]):
        return 0.0
    alike = [index for index, detail in enumerate(details) if detail >= _CONSTANTS.alike * most]
    turn = turns[max(alike, key=lambda index: shown[index].colours)]
    return float(turn if turn <= 180 else turn - 360)


def _pictures(gaussians: Gaussians, turns: range, rotation: np.ndarray) -> list[tuple[Tensor, Tensor]]:
    """Return image [S, S, 3] and alpha [S, S] of a subject from each side, all of one distance."""
    bounds = content_bounds(gaussians).cpu().double().numpy()
    middle, radius = bounds.mean(1), float(np.linalg.norm(bounds[:, 1] - bounds[:, 0])) / 2
    half = math.radians(_CONSTANTS.field_of_view_deg) / 2
    distance, focal = max(radius, 1e-6) / math.sin(half), _CONSTANTS.size_px / 2 / math.tan(half)
    pictures = []
    for pose in orbit_poses(middle, distance, turns, rotation):
        camera = Cameras(
            torch.from_numpy(pose)[None],
            torch.full((1, 2), focal, dtype=torch.float64),
            torch.full((1, 2), _CONSTANTS.size_px / 2, dtype=torch.float64),
            _CONSTANTS.size_px,
            _CONSTANTS.size_px,
        )
        with torch.no_grad():
            drawn = render(gaussians, camera, background=(0, 0, 0), alpha=True)
        pictures.append((drawn.image[0], cast(Tensor, drawn.alpha)[0]))
    return pictures


def orbit_poses(
    middle: np.ndarray, distance: float, turns_deg: Iterable[float], rotation: np.ndarray, tilt_deg: float = 0.0
) -> np.ndarray:
    """Return world-to-camera poses [T, 4, 4] of cameras on a circle round a point, all of which look at it.

    Args:
        middle: [3], the point, scene units.
        distance: Of the cameras from it, scene units.
        turns_deg: T angles that a camera goes to the right.
        rotation: [3, 3], world to camera, of the camera that does not turn.
        tilt_deg: The angle that all cameras go up.
    """
    poses = []
    for turn in turns_deg:
        pose = np.eye(4)
        pose[:3, :3] = orbit_rotation(turn, tilt_deg) @ rotation
        pose[:3, 3] = np.array([0, 0, distance]) - pose[:3, :3] @ middle
        poses.append(pose)
    return np.stack(poses)


class _Shown(NamedTuple):
    """The pixels of a picture's scene, and those of them with detail, each times the entropy of the colours, nats."""

    colours: float
    detail: float


def _shown(picture: tuple[Tensor, Tensor]) -> _Shown:
    """Return how much a picture shows."""
    image, alpha = picture
    there = alpha >= _CONSTANTS.opaque
    if not bool(there.any()):
        return _Shown(0.0, 0.0)
    colours = (image / alpha.clamp_min(_CONSTANTS.opaque)[..., None]).clamp(0, 1)
    levels = (colours[there] * _CONSTANTS.levels).long().clamp_max(_CONSTANTS.levels - 1)
    names = (levels[:, 0] * _CONSTANTS.levels + levels[:, 1]) * _CONSTANTS.levels + levels[:, 2]
    fractions = torch.bincount(names).double() / len(names)
    entropy = float(torch.special.entr(fractions).sum())
    corner = colours[:-1, :-1]
    change = (colours[1:, :-1] - corner).abs().sum(2) + (colours[:-1, 1:] - corner).abs().sum(2)
    inside = there[:-1, :-1] & there[1:, :-1] & there[:-1, 1:]
    return _Shown(len(names) * entropy, float((inside & (change > _CONSTANTS.detail)).sum()) * entropy)
