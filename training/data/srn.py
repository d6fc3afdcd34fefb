"""Reader of SRN-layout folders: one folder per object with rgb/, pose/ and intrinsics.txt.

Source of the layout: Sitzmann et al., "Scene Representation Networks", NeurIPS 2019. Conventions: pose/<name>.txt holds
16 numbers, the camera-to-world matrix by rows, OpenCV axes (x right, y down, z forward), column vectors; intrinsics.txt
holds "focal cx cy 0", the grid's barycentre, a near plane or scale, "height width" and, optionally, a fifth line whose
1 says that the poses are world-to-camera. Focal lengths and centres are in pixels of that height and width.
"""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.errors import InputError

IMAGE_SUFFIXES = (".png", ".webp", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera: focal length and principal point in pixels of a width_px x height_px image."""
    focal_px: float
    centre_x_px: float
    centre_y_px: float
    width_px: int
    height_px: int
    poses_are_world_to_camera: bool = False


@dataclass(frozen=True)
class ObjectViews:
    """The views of one object: V image files, camera_to_world [V,4,4] float64 (OpenCV axes), one set of intrinsics."""
    name: str
    image_paths: tuple[Path, ...]
    camera_to_world: np.ndarray
    intrinsics: Intrinsics


def _numbers(path: Path) -> list[list[float]]:
    """All numbers of a text file, line by line, empty lines left out."""
    try:
        return [[float(word) for word in line.split()] for line in path.read_text().splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: expected lines of numbers, but {error}") from None


def read_intrinsics(path: Path) -> Intrinsics:
    """Read intrinsics.txt. Raises InputError when a line is missing or its numbers make no camera."""
    lines = _numbers(path)
    if len(lines) < 4 or len(lines[0]) < 3 or len(lines[3]) != 2:
        raise InputError(f'{path}: bad intrinsics: expected lines "focal cx cy 0", barycentre, scale, "height width"')
    focal, centre_x, centre_y = lines[0][:3]
    height, width = lines[3]
    if not (np.isfinite([focal, centre_x, centre_y, height, width]).all() and focal > 0):
        raise InputError(f"{path}: bad intrinsics: expected a positive focal length in pixels, got {focal:g}")
    if height < 1 or width < 1 or height != int(height) or width != int(width):
        raise InputError(f"{path}: bad intrinsics: expected a whole height and width, got {height:g} x {width:g}")
    if not (0 <= centre_x <= width and 0 <= centre_y <= height):
        raise InputError(f"{path}: bad intrinsics: principal point ({centre_x:g}, {centre_y:g}) lies outside the "
                         f"{width:g} x {height:g} image")
    inverted = len(lines) > 4 and bool(lines[4][0])
    return Intrinsics(focal, centre_x, centre_y, int(width), int(height), inverted)


def read_pose(path: Path) -> np.ndarray:
    """Read one pose file as a 4x4 float64 matrix. Raises InputError unless it is a proper rigid motion."""
    values = [value for line in _numbers(path) for value in line]
    if len(values) != 16:
        raise InputError(f"{path}: bad pose: expected 16 numbers, got {len(values)}")
    pose = np.array(values, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(pose).all() or not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        raise InputError(f"{path}: bad pose: expected finite numbers and a last row of 0 0 0 1, got {pose[3].tolist()}")
    rotation = pose[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
        raise InputError(f"{path}: bad pose: the upper left 3x3 block is no rotation (its rows are not orthonormal)")
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{path}: wrong handedness: the rotation mirrors (determinant -1); expected right-handed "
                         "OpenCV axes, x right, y down, z forward: negate the axis that was flipped")
    return pose


def find_objects(root: Path) -> list[Path]:
    """All object folders at or below root, sorted. Raises InputError when there is none."""
    root = Path(root)
    if not root.is_dir():
        raise InputError(f"{root}: expected a folder of objects in SRN layout, found no such folder")
    found = sorted({path.parent for part in ("rgb", "pose", "intrinsics.txt") for path in root.rglob(part)})
    if not found:
        raise InputError(f"{root}: found no object: expected <object>/rgb, <object>/pose and <object>/intrinsics.txt")
    return found


def _paired_files(folder: Path) -> list[tuple[Path, Path]]:
    """Images and the pose file of each, by name; raises InputError that names what has no partner."""
    for part in ("rgb", "pose", "intrinsics.txt"):
        if not (folder / part).exists():
            raise InputError(f"{folder}: missing {part}: expected rgb/, pose/ and intrinsics.txt")
    images = {p.stem: p for p in sorted((folder / "rgb").iterdir()) if p.suffix.lower() in IMAGE_SUFFIXES}
    poses = {p.stem: p for p in sorted((folder / "pose").glob("*.txt"))}
    if not images:
        raise InputError(f"{folder}/rgb: found no image: expected files ending in {', '.join(IMAGE_SUFFIXES)}")
    for kind, have, want in (("poses", poses, images), ("images", images, poses)):
        missing = sorted(want.keys() - have.keys())
        if missing:
            raise InputError(f"{folder}: missing {kind}: {len(images)} images but {len(poses)} poses, none for "
                             f"{', '.join(missing[:3])}{' ...' if len(missing) > 3 else ''}")
    return [(images[name], poses[name]) for name in images]


def _point_looked_at(camera_to_world: np.ndarray) -> np.ndarray:
    """The point [3] nearest to all optical axes (least squares; the mean camera distance where they are parallel)."""
    positions, directions = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return np.linalg.lstsq(across.sum(0), (across @ positions[:, :, None]).sum(0)[:, 0], rcond=1e-6)[0]


def _check_looking_at_object(folder: Path, camera_to_world: np.ndarray) -> None:
    """Raise InputError when the cameras look away from the point that their axes meet in (OpenGL axes)."""
    if len(camera_to_world) < 2:
        return
    towards = _point_looked_at(camera_to_world) - camera_to_world[:, :3, 3]
    depths = (towards * camera_to_world[:, :3, 2]).sum(-1)
    if (depths < 0).mean() > 0.5:
        raise InputError(f"{folder}/pose: wrong handedness: the cameras look away from the object (OpenGL axes?); "
                         "expected OpenCV axes, x right, y down, z forward: negate the second and third column of each "
                         "rotation")


def read_object(folder: Path) -> ObjectViews:
    """Read poses and intrinsics of one object folder, and find its images (not decoded here).

    Raises InputError that names the first thing wrong: missing parts, bad intrinsics, bad or missing poses, handedness.
    """
    folder = Path(folder)
    pairs = _paired_files(folder)
    intrinsics = read_intrinsics(folder / "intrinsics.txt")
    poses = np.stack([read_pose(pose) for _, pose in pairs])
    if intrinsics.poses_are_world_to_camera:
        poses = np.linalg.inv(poses)
    _check_looking_at_object(folder, poses)
    return ObjectViews(folder.name, tuple(image for image, _ in pairs), poses, intrinsics)
