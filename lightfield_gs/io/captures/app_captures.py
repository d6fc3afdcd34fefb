"""Captures of apps and trainers: Polycam's raw data, Record3D's, and the cameras.json of a fit.

Source: github.com/PolyCam/polyform (README, "Camera Poses"). keyframes/corrected_cameras and corrected_images hold the
refined poses; cameras and images hold the phone's own tracking. t_00 to t_23 are camera to world, 3 rows of 4, OpenGL
axes. depth has millimetres in 16 bits, confidence 255 where a depth is sure. corrected_images have a black border,
which undistortion left.

Source: github.com/marek-simonik/record3d and nerfstudio's process_data/record3d_utils.py. metadata.json holds w, h, K
(9 numbers, column by column) and perFrameIntrinsicCoeffs (fx, fy, cx, cy). poses are a quaternion x, y, z, w and a
position, camera to world, OpenGL axes. The photographs are rgb/0.jpg and so on, depth/0.exr the depths in metres.

camera_files.py describes cameras.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, is_row, real_number, shown
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.captures.camera_files import read_inria
from lightfield_gs.io.captures.depth_points import DepthFile, depth_points
from lightfield_gs.io.captures.photo_files import PhotoFiles, find_photographs, first_names
from lightfield_gs.io.captures.photograph import PosedCapture, PosedPhotograph, readable_files
from lightfield_gs.io.captures.pinhole import TO_OPENCV, check_intrinsics, check_pose, nearest_rotation, pose_matrix
from lightfield_gs.io.captures.point_files import find_points
from lightfield_gs.io.text_files import read_json, read_object

_LIMIT_BYTES = 256 << 20
_POLYCAM = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
_BORDER_PX = 15  # of Polycam's corrected images, as nerfstudio crops them
_KEYS = ("fx", "fy", "cx", "cy")
_IMAGES = ("images", "input", "")


@dataclass(frozen=True)
class _AppCamera:
    """A camera in an app's file.

    Attributes:
        name: file name of its photograph.
        world_to_camera: [4,4] float64, OpenCV axes.
        intrinsics: [4] float64, (fx, fy, cx, cy) in pixels.
        size_px: width and height.
    """

    name: str
    world_to_camera: np.ndarray
    intrinsics: np.ndarray
    size_px: tuple[int, int]


def read_app_capture(folder: Path, images: Path | None) -> PosedCapture | None:
    """Read a capture in one of these layouts.

    Args:
        folder: the capture, or a cameras.json or metadata.json itself.
        images: the folder of the photographs; None: where the layout has them.

    Returns:
        The capture; None where the folder is in none of these layouts.

    Raises:
        InputError: names the file and the field.
    """
    root = folder if folder.is_dir() else folder.parent
    for keyframes in (root / "keyframes", root):
        for cameras, pictures in _POLYCAM if folder.is_dir() else ():
            if (files := _json_files(keyframes / cameras)) and (keyframes / pictures).is_dir():
                found = [_read_polycam(path) for path in files]
                capture = _posed_capture(keyframes / cameras, found, [images or keyframes / pictures], [root])
                return _with_depths(_without_border(capture), keyframes / "depth", 1e-3, keyframes / "confidence")
    if (path := _find_json(folder, "metadata.json")) and "poses" in (data := _object(path)):
        folders = [images] if images else [root / "rgb", root / "rgbd", root]
        return _with_depths(_posed_capture(path, _record3d_cameras(path, data), folders, [root]), root / "depth", 1.0)
    if path := _find_json(folder, "cameras.json"):
        return _posed_capture(
            path, _inria_cameras(path), [images] if images else [root / name for name in _IMAGES], [root]
        )
    return None


def _find_json(folder: Path, name: str) -> Path | None:
    """Return the file of this name in a folder, or a .json that was given itself.

    A list is a cameras.json, an object a metadata.json.
    """
    if not folder.is_file():
        return path if (path := folder / name).is_file() else None
    if folder.suffix.lower() != ".json":
        return None
    return folder if isinstance(read_json(folder, _LIMIT_BYTES), list) == (name == "cameras.json") else None


def _object(path: Path) -> dict[str, Any]:
    data = read_json(path, _LIMIT_BYTES)
    return data if isinstance(data, dict) else {}


def _json_files(folder: Path) -> list[Path]:
    """Return the visible .json files of a folder; none where there is no such folder."""
    if not folder.is_dir():
        return []
    with reading(folder):
        return sorted(p for p in folder.iterdir() if p.suffix.lower() == ".json" and not p.name.startswith("."))


def _posed_capture(
    source: Path, cameras: Sequence[_AppCamera], folders: Sequence[Path], roots: Sequence[Path]
) -> PosedCapture:
    """Find the photographs of these cameras in the first folder that has them; look for points in `roots`."""
    found = find_photographs(folders, [camera.name for camera in cameras])
    files = readable_files(found.files, found.folder)
    posed = [
        PosedPhotograph(*files[camera.name], camera.world_to_camera, camera.intrinsics, camera.size_px)
        for camera in cameras
        if camera.name in files
    ]
    return PosedCapture(source, found.folder, posed, *find_points(None, roots))


def _without_border(capture: PosedCapture) -> PosedCapture:
    """Leave the border of Polycam's corrected images out, with a note."""
    if capture.images.name != _POLYCAM[0][1]:
        return capture
    assume(f"{_BORDER_PX} pixels at each edge of {capture.images} do not count: Polycam's undistortion leaves black")
    return replace(capture, photographs=[replace(one, border_px=_BORDER_PX) for one in capture.photographs])


def _with_depths(capture: PosedCapture, depths: Path, unit: float, confidences: Path | None = None) -> PosedCapture:
    """Add points by depth maps in a folder, which are named as the photographs, where there are no others."""
    if len(capture.points):
        return capture
    maps, sure = (_images_by_stem(folder) for folder in (depths, confidences))
    stems = {one.name: PurePosixPath(one.name).stem for one in capture.photographs}
    files = {name: DepthFile(maps[stem], unit, sure.get(stem)) for name, stem in stems.items() if stem in maps}
    points, colours = depth_points(capture.photographs, files)
    return replace(capture, points=points, colours=colours)


def _images_by_stem(folder: Path | None) -> dict[str, Path]:
    if folder is None or not folder.is_dir():
        return {}
    return {path.stem: path for path in PhotoFiles(folder, (".exr",)).paths.values()}


def _read_polycam(path: Path) -> _AppCamera:
    """Read the camera of one keyframe. Raises InputError."""
    data = read_object(path, _LIMIT_BYTES)
    number = {key: _number(path, data, key, -1e12, 1e12) for key in _KEYS}
    width, height = (_number(path, data, key, 1, 1 << 20) for key in ("width", "height"))
    pose = np.eye(4)
    pose[:3] = [[_number(path, data, f"t_{row}{column}", -1e12, 1e12) for column in range(4)] for row in range(3)]
    check_pose(str(path), pose)
    intrinsics = np.array([number[key] for key in _KEYS])
    check_intrinsics(str(path), intrinsics, width, height)
    return _AppCamera(f"{path.stem}.jpg", _inverse(pose @ TO_OPENCV), intrinsics, (int(width), int(height)))


def _record3d_cameras(path: Path, data: dict[str, Any]) -> list[_AppCamera]:
    """Return the cameras of a metadata.json; leave out frames without a pose, with a note. Raises InputError."""
    poses, middle, each = data["poses"], data.get("K"), data.get("perFrameIntrinsicCoeffs")
    if not isinstance(poses, list) or not poses or not isinstance(middle, list) or len(middle) != 9:
        raise InputError(f"{path}: expected poses (7 numbers each) and K (9 numbers), got {shown(middle)}")
    size = int(_number(path, data, "w", 1, 1 << 20)), int(_number(path, data, "h", 1, 1 << 20))
    shared = [real_number(f"{path}: K", middle[index], -1e12, 1e12) for index in (0, 4, 6, 7)]
    cameras, lost = [], []
    for index, numbers in enumerate(poses):
        where = f"{path}: poses[{index}]"
        if not is_row(numbers, 7):
            raise InputError(f"{where}: expected a quaternion x, y, z, w and a place, got {shown(numbers)}")
        if any(number is None or number != number for number in numbers):
            lost.append(str(index))
            continue
        x, y, z, w, *position = (real_number(where, number, -1e12, 1e12) for number in numbers)
        pose = pose_matrix((w, x, y, z), position)
        if pose is None:
            lost.append(str(index))
            continue
        own = each[index] if isinstance(each, list) and len(each) == len(poses) else shared
        if not is_row(own, 4):
            raise InputError(f"{path}: perFrameIntrinsicCoeffs[{index}]: expected fx, fy, cx, cy, got {shown(own)}")
        intrinsics = np.array([real_number(f"{path}: intrinsics", number, -1e12, 1e12) for number in own])
        check_intrinsics(where, intrinsics, *size)
        cameras.append(_AppCamera(f"{index}.jpg", _inverse(pose @ TO_OPENCV), intrinsics, size))
    if not cameras:
        raise InputError(f"{path}: expected photographs with poses, got {len(poses)} without")
    if lost:
        words = counted(len(lost), "frame", len(poses), "have no pose there and are left out")
        assume(f"{path}: {words}: {first_names(lost)}")
    return cameras


def _inria_cameras(path: Path) -> list[_AppCamera]:
    """Read the cameras of a cameras.json. Raises InputError."""
    return [
        _AppCamera(
            camera.name,
            camera.world_to_camera,
            np.array([*camera.focal_px, *camera.principal_point_px]),
            (int(camera.width_px), int(camera.height_px)),
        )
        for camera in read_inria(path)
    ]


def _inverse(camera_to_world: np.ndarray) -> np.ndarray:
    """Invert a rigid motion: world to camera [4,4] from camera to world."""
    rotation = nearest_rotation(camera_to_world[:3, :3]).T
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = rotation, -rotation @ camera_to_world[:3, 3]
    return inverse


def _number(path: Path, data: dict[str, Any], key: str, low: float, high: float) -> float:
    if data.get(key) is None:
        raise InputError(f"{path}: {key}: missing: expected a number")
    return real_number(f"{path}: {key}", data[key], low, high)
