"""The records of COLMAP's files, whatever they are stored as, and what has to hold of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import COLMAP_MODELS

_MAX_SIZE_PX = 1 << 20
_LONGEST_NAME = 4096  # more than any system lets a path have


@dataclass(frozen=True)
class ColmapCamera:
    """A camera: the name of its model, the size of its pictures, and its parameters in COLMAP's order.

    intrinsics: [4] float64, (fx, fy, cx, cy) in pixels from the outer corner of the first. coefficients: those of the
    model's formula.
    """

    model: str
    width_px: int
    height_px: int
    intrinsics: np.ndarray
    coefficients: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """A photograph: its name (with / between folders), its camera's number, world_to_camera [4,4] float64 (OpenCV
    axes); None where the file has no pose of it; and its own number. A name that is no UTF-8 has its bytes as Python's
    surrogates, until names_decoded knows better."""

    name: str
    camera: int
    world_to_camera: np.ndarray | None
    number: int = 0


Sensor = tuple[int, int]  # kind and number; CAMERA is a kind, and its number that of a camera
CAMERA = 0


@dataclass(frozen=True)
class ColmapFrame:
    """What one rig saw at one time: world to rig [4,4] float64, None where it has no pose, and the photographs' numbers
    by the cameras that took them."""

    rig: int
    world_to_rig: np.ndarray | None
    images: dict[Sensor, int]


Rigs = dict[int, dict[Sensor, np.ndarray | None]]  # by number: rig to sensor [4,4] float64, None where it is not known


def camera_record(model: str, width: int, height: int, parameters: Sequence[float]) -> ColmapCamera:
    """A camera of these numbers. Raises InputError where they make none."""
    if model not in COLMAP_MODELS:
        raise InputError(f"camera model: expected one of {', '.join(COLMAP_MODELS)}, got {shown(model)}")
    kind = COLMAP_MODELS[model]
    if len(parameters) != kind.parameters:
        raise InputError(f"camera of {model}: expected {kind.parameters} parameters, got {len(parameters)}")
    if not (1 <= width <= _MAX_SIZE_PX and 1 <= height <= _MAX_SIZE_PX):
        raise InputError(f"camera of {model}: expected a size of 1..{_MAX_SIZE_PX} pixels, got {width} x {height}")
    numbers = np.array(parameters, np.float64)
    if not (np.abs(numbers) < 1e12).all() or not (numbers[: kind.focal_lengths] > 0).all():
        raise InputError(
            f"camera of {model}: expected finite numbers and a focal length > 0, got {numbers.tolist()[:4]}"
        )
    focal = numbers[[0, kind.focal_lengths - 1]]
    centre = numbers[kind.focal_lengths : kind.focal_lengths + 2]
    coefficients = tuple(numbers[kind.focal_lengths + 2 :].tolist())
    return ColmapCamera(model, width, height, np.concatenate([focal, centre]), coefficients)


def image_record(
    name: str, camera: int, quaternion: Sequence[float], translation: Sequence[float], number: int = 0
) -> ColmapImage:
    """A photograph of these numbers: quaternion w, x, y, z of any length, and translation, world to camera."""
    if not name.strip() or "\0" in name or len(name) > _LONGEST_NAME:
        raise InputError(f"images: expected the name of a photograph, got {shown(name)}")
    name = name if is_undecoded(name) else name.replace("\\", "/")  # in some code pages a backslash is half a letter
    return ColmapImage(name, camera, pose_of(quaternion, translation), number)


def is_undecoded(name: str) -> bool:
    """Whether a name holds bytes that are no UTF-8, as surrogates."""
    return any("\ud800" <= letter <= "\udfff" for letter in name)


def pose_of(quaternion: Sequence[float], translation: Sequence[float]) -> np.ndarray | None:
    """The pose [4,4] float64 of a quaternion w, x, y, z of any length and a translation; None where they are none."""
    numbers = np.array([*quaternion, *translation], np.float64)
    if not (np.abs(numbers) < 1e12).all() or (length := np.linalg.norm(numbers[:4])) <= 1e-9:
        return None
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_of(numbers[:4] / length), numbers[4:]
    return pose


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """The rotation [3,3] of a unit quaternion w, x, y, z: v + 2 w (q x v) + 2 q x (q x v)."""
    w, (x, y, z) = quaternion[0], quaternion[1:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross
