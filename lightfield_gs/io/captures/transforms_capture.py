"""Captures whose cameras are in a transforms.json: nerfstudio's, instant-ngp's and NeRF's.

Source: nerfstudio's data conventions; Müller et al., "Instant Neural Graphics Primitives", 2022. As in transforms.py,
but for scenes: the cameras may be of several sizes and of any model that COLMAP has (camera_model; is_fisheye is
OPENCV_FISHEYE), with its coefficients by their names; file_path is as the images folder or its reduced copies have it;
ply_file_path names points in the world of the poses (applied_transform tells how that came about, and changes
neither). scale, offset, aabb_scale and what else is about other programs are not read.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lightfield_gs.base.checks import real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import COLMAP_MODELS, Lens, lens_of
from lightfield_gs.io.captures.files import named_image
from lightfield_gs.io.captures.lens import COEFFICIENTS, distorted, words
from lightfield_gs.io.captures.photo_files import missing_photographs, photographs_in
from lightfield_gs.io.captures.pinhole import MODELS, TO_OPENCV, focal_lengths, nearest_rotation
from lightfield_gs.io.captures.shot import Shot, Shots
from lightfield_gs.io.captures.views import check_intrinsics, check_pose
from lightfield_gs.io.images import read_info
from lightfield_gs.io.json_file import read_object
from lightfield_gs.io.scenes.ply_data import read_elements
from lightfield_gs.io.scenes.ply_header import HEADER_LIMIT_BYTES, read_header

_LIMIT_BYTES = 256 << 20
_FURTHER = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "p3", "p4")  # of lenses that are none of MODELS


def transforms_file(folder: Path) -> Path | None:
    """The transforms.json of a capture, or the file itself that was given; None where there is none."""
    path = folder if folder.suffix.lower() == ".json" else folder / "transforms.json"
    return path if path.is_file() else None


def transforms_shots(path: Path, images: Path | None) -> Shots:
    """What a transforms.json says of the photographs of a capture. images: their folder; None: where the file has
    them. Raises InputError that names file and field."""
    data = read_object(path, _LIMIT_BYTES)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: expected a list of views, got {shown(frames)}")
    names = []
    for index, frame in enumerate(frames):
        name = frame.get("file_path") if isinstance(frame, dict) else None
        if not isinstance(name, str) or not name.strip() or "\0" in name:
            raise InputError(f"{path}: frames[{index}].file_path: expected the name of an image, got {shown(name)}")
        names.append(PurePosixPath(os.path.normpath(name.replace("\\", "/"))).as_posix())
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: frames: expected each photograph once, got {shown(twice)} twice")
    folder, names, paths = _photographs(path, images, names)
    shots = [
        _shot(f"{path}: frames[{index}]", path.parent, {**data, **frame}, name, photo)
        for index, (frame, name, photo) in enumerate(zip(frames, names, paths))
    ]
    return Shots(path, folder, shots, *_points(path, data.get("ply_file_path")))


def _photographs(path: Path, images: Path | None, names: list[str]) -> tuple[Path, list[str], list[Path]]:
    """The folder of images, the photographs' names in it, and their files."""
    common = os.path.commonpath([str(PurePosixPath(name).parent) for name in names])
    inner = [PurePosixPath(name).relative_to(common).as_posix() for name in names]
    if images is not None:
        files, paths = photographs_in([images], inner)
        return files.folder, inner, paths
    found: list[Path] = []
    missing = []
    for name in names:
        try:
            found.append(named_image("file_path", path.parent, name))
        except InputError as error:
            if "missing" not in str(error):
                raise InputError(f"{path}: {error}") from None
            missing.append(name)
    if missing:
        raise InputError(f"{path}: {missing_photographs(path.parent, missing, len(names))}")
    return path.parent / common, inner, found


def _shot(where: str, folder: Path, fields: dict[str, Any], name: str, photo: Path) -> Shot:
    def number(key: str) -> float | None:
        low, high = (1e-6, 3.14159) if key.startswith("camera_angle") else (-1e12, 1e12)
        return None if fields.get(key) is None else real_number(f"{where}.{key}", fields[key], low, high)

    width, height = number("w"), number("h")
    if width is None or height is None:
        info = read_info(photo)
        width, height = float(info.width_px), float(info.height_px)
    focal = focal_lengths(number, width, height)
    if focal is None:
        raise InputError(f"{where}: missing focal length: give fl_x (pixels) or camera_angle_x (radians)")
    cx, cy = number("cx"), number("cy")
    intrinsics = np.array([*focal, width / 2 if cx is None else cx, height / 2 if cy is None else cy])
    check_intrinsics(where, intrinsics, width, height)
    mask = None
    if fields.get("mask_path") is not None:
        mask = named_image(f"{where}.mask_path", folder, fields["mask_path"])
    size = int(width), int(height)
    return Shot(name, photo, _world_to_camera(where, fields), intrinsics, size, _lens(where, fields, number), mask)


def _world_to_camera(where: str, fields: dict[str, Any]) -> np.ndarray:
    where = f"{where}.transform_matrix"
    try:
        pose = np.array(fields.get("transform_matrix"))
    except ValueError:
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got rows of different lengths") from None
    if pose.shape not in ((4, 4), (3, 4)) or pose.dtype.kind not in "iuf":
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got {pose.dtype} {list(pose.shape)}")
    pose = np.concatenate([pose[:3], [[0, 0, 0, 1]]]).astype(np.float64)
    check_pose(where, pose)
    rotation = nearest_rotation((pose @ TO_OPENCV)[:3, :3]).T
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = rotation, -rotation @ pose[:3, 3]
    return inverse


def _lens(where: str, fields: dict[str, Any], number: Callable[[str], float | None]) -> Lens | None:
    model = "OPENCV_FISHEYE" if fields.get("is_fisheye") is True else fields.get("camera_model") or "PINHOLE"
    if model in MODELS:
        if unknown := [key for key in _FURTHER if number(key)]:
            raise InputError(
                f"{where}.{unknown[0]}: expected a lens of {', '.join(COEFFICIENTS)} alone with the camera_model "
                f"{model}, got {shown(fields[unknown[0]])}"
            )
        coefficients = tuple(number(key) or 0.0 for key in COEFFICIENTS)
        said = words(np.array(coefficients))
        return Lens(_brown, coefficients, f"{model} {said}") if any(coefficients) else None
    if model not in COLMAP_MODELS:
        raise InputError(
            f"{where}.camera_model: expected one of {', '.join(COLMAP_MODELS)}, got {shown(model)}: make perspective "
            "photographs of these first"
        )
    keys = [("k1" if key == "k" else key) for key in COLMAP_MODELS[model].coefficients]
    return lens_of(model, [number(key) or 0.0 for key in keys])


def _brown(points: np.ndarray, *coefficients: float) -> np.ndarray:
    return distorted(points, np.array(coefficients))


def _points(path: Path, name: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] and colours [P,3] uint8 of the .ply that a transforms.json names; none where it names none."""
    if name is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    if not isinstance(name, str) or not name.strip() or "\0" in name or not (path.parent / name).is_file():
        raise InputError(f"{path}: ply_file_path: expected the name of a .ply file beside it, got {shown(name)}")
    ply = path.parent / name
    with ply.open("rb") as file:
        header = read_header(ply, file.read(HEADER_LIMIT_BYTES))
    vertices = read_elements(ply, header).get("vertex")
    columns = () if vertices is None else vertices.dtype.names or ()
    if vertices is None or not {"x", "y", "z"} <= set(columns):
        raise InputError(f"{ply}: expected points with x, y and z")
    points = np.stack([vertices[key].astype(np.float64) for key in "xyz"], 1)
    colours = np.full(points.shape, 128, np.uint8)  # grey where the file has no colours
    for column, key in enumerate(("red", "green", "blue")):
        if key in columns:
            values = vertices[key]
            full = 1 if values.dtype.kind == "u" else 255  # of floats, 0..1
            colours[:, column] = np.rint(np.nan_to_num(np.clip(values * full, 0, 255)))
    return points, colours
