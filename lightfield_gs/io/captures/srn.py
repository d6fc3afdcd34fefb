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

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.masks import masks_beside
from lightfield_gs.io.captures.photo_files import is_hidden
from lightfield_gs.io.captures.views import (
    IMAGE_SUFFIXES,
    ObjectViews,
    check_intrinsics,
    check_looking_at_object,
    check_pose,
)

PARTS = ("rgb", "pose", "intrinsics.txt")
_AXES = "OpenCV axes, x right, y down, z forward: from OpenGL axes, negate the second and third column of each rotation"


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera: focal length and principal point in pixels of a width_px x height_px image."""

    focal_px: float
    centre_x_px: float
    centre_y_px: float
    width_px: int
    height_px: int
    poses_are_world_to_camera: bool = False


def _numbers(path: Path) -> list[list[float]]:
    """All numbers of a text file, line by line, empty lines left out."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        return [[float(word) for word in line.split()] for line in text.splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: expected lines of numbers, but {str(error)[:100]}") from None


def read_intrinsics(path: Path) -> Intrinsics:
    """Read intrinsics.txt. Raises InputError when a line is missing or its numbers make no camera."""
    lines = _numbers(path)
    if len(lines) < 4 or len(lines[0]) < 3 or len(lines[3]) != 2:
        raise InputError(f'{path}: bad intrinsics: expected lines "focal cx cy 0", barycentre, scale, "height width"')
    focal, centre_x, centre_y = lines[0][:3]
    height, width = lines[3]
    check_intrinsics(str(path), np.array([focal, focal, centre_x, centre_y]), width, height)
    inverted = len(lines) > 4 and bool(lines[4][0])
    return Intrinsics(focal, centre_x, centre_y, int(width), int(height), inverted)


def read_pose(path: Path) -> np.ndarray:
    """Read one pose file as a 4x4 float64 matrix. Raises InputError unless it is a proper rigid motion."""
    values = [value for line in _numbers(path) for value in line]
    if len(values) != 16:
        raise InputError(f"{path}: bad pose: expected 16 numbers, got {len(values)}")
    pose = np.array(values, dtype=np.float64).reshape(4, 4)
    check_pose(str(path), pose)
    return pose


def _paired_files(folder: Path) -> list[tuple[Path, Path]]:
    """Images and the pose file of each, by name; raises InputError that names what has no partner."""
    for part in PARTS:
        if not (folder / part).exists():
            raise InputError(f"{folder}: missing {part}: expected rgb/, pose/ and intrinsics.txt")
    images, poses = (
        {p.stem: p for p in sorted((folder / part).iterdir()) if p.suffix.lower() in suffixes and not is_hidden(p.name)}
        for part, suffixes in (("rgb", IMAGE_SUFFIXES), ("pose", (".txt",)))
    )
    if not images:
        raise InputError(f"{folder}/rgb: found no image: expected files ending in {', '.join(IMAGE_SUFFIXES)}")
    for kind, have, want in (("poses", poses, images), ("images", images, poses)):
        missing = sorted(want.keys() - have.keys())
        if missing:
            raise InputError(
                f"{folder}: missing {kind}: {len(images)} images but {len(poses)} poses, none for "
                f"{', '.join(missing[:3])}{' ...' if len(missing) > 3 else ''}"
            )
    return [(images[name], poses[name]) for name in images]


def read_srn(folder: Path) -> ObjectViews:
    """Read poses and intrinsics of one object folder, and find its images (not decoded here).

    Raises InputError that names the first thing wrong: missing parts, bad intrinsics, bad or missing poses, handedness.
    """
    folder = Path(folder)
    pairs = _paired_files(folder)
    camera = read_intrinsics(folder / "intrinsics.txt")
    poses = np.stack([read_pose(pose) for _, pose in pairs])
    if camera.poses_are_world_to_camera:
        poses = np.linalg.inv(poses)
    check_looking_at_object(f"{folder}/pose", poses, _AXES)
    row = (camera.focal_px, camera.focal_px, camera.centre_x_px, camera.centre_y_px)
    images = [image for image, _ in pairs]
    return ObjectViews(
        folder.name,
        tuple(images),
        poses,
        np.tile(row, (len(poses), 1)),
        camera.width_px,
        camera.height_px,
        f"{folder / 'intrinsics.txt'}: height width",
        masks_beside(folder, images),
    )
