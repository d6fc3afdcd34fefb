"""Files of cameras that trainers of 3D Gaussians write: Inria's cameras.json and NeRF's transforms.json.

cameras.json, source: Kerbl et al., "3D Gaussian Splatting", 2023. A list of objects with position (the camera's
centre), rotation (camera to world, rows, OpenCV axes), fx, fy, width and height. cx and cy are there unless the
principal point is the middle.

transforms.json, source: Mildenhall et al., "NeRF", 2020; Müller et al., "Instant NGP", 2022. Each of the frames has a
transform_matrix (camera to world, OpenGL axes: x right, y up, z backward). A frame, or the top for all, has w, h,
fl_x, fl_y or camera_angle_x, camera_angle_y (radians), cx, cy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.checks import real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import BROWN_COEFFICIENTS
from lightfield_gs.io.captures.dataparser import find_dataparser_transform
from lightfield_gs.io.captures.pinhole import (
    PINHOLE_MODELS,
    TO_OPENCV,
    focal_lengths,
    nearest_rotation,
    note_scales,
    remove_scale,
)
from lightfield_gs.io.images import read_info
from lightfield_gs.io.text_files import read_json

LIMIT_BYTES = 256 << 20
_ORTHONORMAL = 1e-3  # tolerance of rows; few digits are rounded to a rotation
_MAX_SIZE_PX = 1 << 20
_SIZE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")  # what file_path may leave out


@dataclass(frozen=True)
class FileCamera:
    """One camera of a file.

    Attributes:
        name: of its image, or its number.
        world_to_camera: [4,4] float64, OpenCV axes, scene units.
        focal_px: (fx, fy) in pixels of its image.
        principal_point_px: (cx, cy), from the outer corner of the first pixel.
        width_px, height_px: size of its image. Where neither the file nor an image tells it, the image is taken as
            square and one unit wide.
        assumed: the assumption about its size, in words.
        distorted: whether the file has lens distortion, which these numbers leave out.
    """

    name: str
    world_to_camera: np.ndarray
    focal_px: tuple[float, float]
    principal_point_px: tuple[float, float]
    width_px: float
    height_px: float
    assumed: str = ""
    distorted: bool = False

    def fitted(self, width_px: int, height_px: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return focal lengths and principal point that fit the whole image into a panel of this size, centred."""
        scale = min(width_px / self.width_px, height_px / self.height_px)
        (fx, fy), (cx, cy) = self.focal_px, self.principal_point_px
        return (
            (fx * scale, fy * scale),
            (width_px / 2 + (cx - self.width_px / 2) * scale, height_px / 2 + (cy - self.height_px / 2) * scale),
        )

    def turned(self, quarters: int) -> FileCamera:
        """Roll the camera about its axis, so that its image turns clockwise by this number of quarters."""
        camera = self
        for _ in range(quarters % 4):
            (fx, fy), (cx, cy) = camera.focal_px, camera.principal_point_px
            right, down, *rest = camera.world_to_camera
            camera = replace(
                camera,
                world_to_camera=np.stack([-down, right, *rest]),
                focal_px=(fy, fx),
                principal_point_px=(camera.height_px - cy, cx),
                width_px=camera.height_px,
                height_px=camera.width_px,
            )
        return camera


def is_camera_file(data: Any) -> bool:
    """Return whether JSON data looks like either kind. Calibrations of displays may be lists too."""
    if isinstance(data, list):
        return any(isinstance(entry, dict) and ("position" in entry or "rotation" in entry) for entry in data[:1])
    return isinstance(data, dict) and "frames" in data


def read_camera_file(path: str | Path) -> list[FileCamera]:
    """Read the cameras of either kind of file, in its order.

    Raises:
        InputError: names the file and the key.
    """
    data = read_json(path, LIMIT_BYTES)
    if isinstance(data, list):
        return _inria(path, data)
    if is_camera_file(data):
        return _transforms(path, data)
    if isinstance(data, dict) and "world_to_camera" in data:
        raise InputError(
            f"{path}: holds one camera for each view (world_to_camera, focal_px); give it as cameras=, "
            "with method=sorted"
        )
    raise InputError(
        f"{path}: expected a list of cameras (cameras.json, with position and rotation) or an object with "
        f"the key frames (transforms.json), got {shown(data)}"
    )


def read_inria(path: str | Path) -> list[FileCamera]:
    """Read the cameras of a cameras.json. Raises InputError."""
    data = read_json(path, LIMIT_BYTES)
    if not isinstance(data, list):
        raise InputError(
            f"{path}: expected a list of cameras, as 3D Gaussian splatting writes cameras.json, got "
            f"{type(data).__name__}"
        )
    return _inria(path, data)


def read_transforms(path: str | Path) -> list[FileCamera]:
    """Read the cameras of a transforms.json. Raises InputError."""
    data = read_json(path, LIMIT_BYTES)
    if not isinstance(data, dict):
        raise InputError(
            f"{path}: expected an object with the key frames, as in transforms.json, got {type(data).__name__}"
        )
    return _transforms(path, data)


def _inria(path: str | Path, data: list) -> list[FileCamera]:
    cameras, scales = [], []
    for index, entry in enumerate(_objects(f"{path}: ", data, "position, rotation, fx, fy, width, height")):
        where = f"{path}: [{index}]"
        width, height = (_number(where, entry, key, 1, _MAX_SIZE_PX) for key in ("width", "height"))
        fx, fy = (_number(where, entry, key, 1e-6, 1e9) for key in ("fx", "fy"))
        centre = _centre(where, entry, width, height)
        position = _array(f"{where}.position", entry.get("position"), (3,))
        rotation, scale = _rotation(f"{where}.rotation", _array(f"{where}.rotation", entry.get("rotation"), (3, 3)))
        scales.append(scale)
        name = entry.get("img_name", entry.get("id", index))
        pose = _pose(rotation, position)
        cameras.append(FileCamera(shown(name).strip("'\""), pose, (fx, fy), centre, width, height))
    note_scales(path, scales)
    return cameras


def _transforms(path: str | Path, data: dict[str, Any]) -> list[FileCamera]:
    frames = data.get("frames")
    if not isinstance(frames, list):
        raise InputError(f"{path}: frames: expected a list of views, got {shown(frames)}")
    frames = _objects(f"{path}: frames", frames, "transform_matrix")
    images = _ImageSizes(Path(path).parent)
    found = [_frame(f"{path}: frames[{index}]", {**data, **frame}, images) for index, frame in enumerate(frames)]
    note_scales(path, [scale for _, scale in found])
    if (moved := find_dataparser_transform(Path(path))) is None:
        return [camera for camera, _ in found]
    return [replace(camera, world_to_camera=moved.pose(camera.world_to_camera)) for camera, _ in found]


def _frame(where: str, fields: dict[str, Any], images: _ImageSizes) -> tuple[FileCamera, float]:
    """Return the camera of a frame, and the scale that its rotation was divided by."""
    matrix = _array(f"{where}.transform_matrix", fields.get("transform_matrix"), None)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{where}.transform_matrix: expected 4 rows of 4 numbers, got {list(matrix.shape)}")
    rotation, scale = _rotation(f"{where}.transform_matrix", matrix[:3, :3])
    model = fields.get("camera_model", "PINHOLE")
    if model not in PINHOLE_MODELS or fields.get("is_fisheye") is True:
        raise InputError(
            f"{where}.camera_model: expected a pinhole camera ({', '.join(PINHOLE_MODELS)}), got "
            f"{shown(model)}; a panel shows flat perspective only"
        )
    width, height, assumed = _size(where, fields, images)
    focal = _focal(where, fields, width, height)
    centre = _centre(where, fields, width, height)
    distorted = any(
        fields.get(key) is not None and _number(where, fields, key, -1e9, 1e9) for key in BROWN_COEFFICIENTS
    )
    name = shown(fields.get("file_path", "")).strip("'\"")
    pose = _pose(rotation @ TO_OPENCV[:3, :3], matrix[:3, 3])
    return FileCamera(name, pose, focal, centre, width, height, assumed, distorted), scale


def _size(where: str, fields: dict[str, Any], images: _ImageSizes) -> tuple[float, float, str]:
    """Return width and height of the image, and the assumption about them."""
    if fields.get("w") is not None and fields.get("h") is not None:
        return _number(where, fields, "w", 1, _MAX_SIZE_PX), _number(where, fields, "h", 1, _MAX_SIZE_PX), ""
    if (size := images.find(fields.get("file_path"))) is not None:
        return *size, ""
    if fields.get("fl_x") is None and fields.get("fl_y") is None:
        return 1.0, 1.0, "its image is taken as square: the file does not say w and h, and there is no image"
    raise InputError(
        f"{where}.w: expected w and h, the size of the image, beside fl_x: neither does the file say it, "
        "nor is there the image of file_path"
    )


def _centre(where: str, fields: dict[str, Any], width: float, height: float) -> tuple[float, float]:
    """Return the principal point: cx and cy, or the middle of the image."""
    cx, cy = (
        side / 2 if fields.get(key) is None else _number(where, fields, key, -1e9, 1e9)
        for key, side in (("cx", width), ("cy", height))
    )
    return cx, cy


def _focal(where: str, fields: dict[str, Any], width: float, height: float) -> tuple[float, float]:
    def number(key: str) -> float | None:
        low, high = (1e-6, 3.14159) if key.startswith("camera_angle") else (1e-6, 1e9)
        return None if fields.get(key) is None else _number(where, fields, key, low, high)

    found = focal_lengths(number, width, height)
    if found is None:
        raise InputError(f"{where}.fl_x: missing: expected fl_x (pixels) or camera_angle_x (radians)")
    return found


class _ImageSizes:
    """Sizes of the images that frames name. The first image that exists stands for all."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.known: tuple[float, float] | None = None
        self.tried: set[str] = set()

    def find(self, name: Any) -> tuple[float, float] | None:
        if self.known is None and isinstance(name, str) and "\0" not in name and name not in self.tried:
            self.tried.add(name)
            found = (
                path for suffix in _SIZE_SUFFIXES if _is_file(path := self.folder / (name.replace("\\", "/") + suffix))
            )
            if (image := next(found, None)) is not None:
                info = read_info(image)
                self.known = float(info.width_px), float(info.height_px)
        return self.known


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # no file can have this name
        return False


def _objects(where: str, entries: list, expected: str) -> list[dict[str, Any]]:
    if not entries:
        raise InputError(f"{where.rstrip(' :')}: there are no cameras in it")
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise InputError(f"{where}[{index}]: expected an object with {expected}, got {shown(entry)}")
    return entries


def _number(where: str, entry: dict[str, Any], key: str, low: float, high: float) -> float:
    if entry.get(key) is None:
        raise InputError(f"{where}.{key}: missing: expected a number")
    return real_number(f"{where}.{key}", entry[key], low, high)


def _array(what: str, value: Any, shape: tuple[int, ...] | None) -> np.ndarray:
    """Return `value` as finite float64 of this shape (None: any). Raises InputError."""
    expected = "numbers" if shape is None else f"numbers {list(shape)}"
    try:
        array = np.array(value)
    except ValueError:
        raise InputError(f"{what}: expected {expected}, got rows of different lengths") from None
    if array.dtype.kind not in "iuf" or shape is not None and array.shape != shape:
        raise InputError(f"{what}: expected {expected}, got {shown(value)}")
    array = array.astype(np.float64)
    if not (np.abs(array) < 1e12).all():
        raise InputError(f"{what}: expected finite numbers, got {shown(value)}")
    return array


def _rotation(what: str, matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the rotation nearest to a matrix, and the scale that the matrix was divided by.

    Raises:
        InputError: for shear and mirroring.
    """
    matrix, scale = remove_scale(matrix)
    error = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not error <= _ORTHONORMAL or np.linalg.det(matrix) < 0:
        raise InputError(
            f"{what}: expected a rotation (orthonormal, determinant +1), got {shown(matrix.tolist())}; "
            "shear and mirroring are not allowed"
        )
    return nearest_rotation(matrix), scale


def _pose(rotation: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return world_to_camera [4,4] of a camera with these axes (columns, in world axes) and this centre."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ centre
    return pose
