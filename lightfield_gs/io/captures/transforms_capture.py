"""Captures whose cameras are in a transforms.json: nerfstudio's, instant-ngp's and NeRF's.

Source: nerfstudio's data conventions; Müller et al., "Instant Neural Graphics Primitives", 2022. As in transforms.py,
but for scenes: the cameras may be of several sizes and of any model that COLMAP has (camera_model; is_fisheye is
OPENCV_FISHEYE), with its coefficients by their names; file_path is as the images folder or its reduced copies have it;
ply_file_path names points in the world of the poses (applied_transform tells how that came about, and changes
neither); without it they are looked for beside the file. scale, offset, aabb_scale and what else is about other
programs are not read.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import COLMAP_MODELS, Lens, lens_of
from lightfield_gs.io.captures.colmap_capture import model_folder
from lightfield_gs.io.captures.files import named_image
from lightfield_gs.io.captures.lens import COEFFICIENTS, distorted, words
from lightfield_gs.io.captures.photo_files import Places, photographs_in
from lightfield_gs.io.captures.pinhole import MODELS, TO_OPENCV, focal_lengths, nearest_rotation, say_scales, unscaled
from lightfield_gs.io.captures.point_files import points_beside, points_of_model, read_points
from lightfield_gs.io.captures.readable import readable
from lightfield_gs.io.captures.shot import Shot, Shots
from lightfield_gs.io.captures.transforms_frames import Frame, read_frames
from lightfield_gs.io.captures.views import check_intrinsics, check_pose
from lightfield_gs.io.images import read_info

_ANGLES_DIFFER = 0.02  # of an angle of view: what lens distortion and rounding make of one camera is less
_FURTHER = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "p3", "p4")  # of lenses that are none of MODELS


def transforms_shots(path: Path, images: Path | None, given: bool) -> Shots:
    """What a transforms.json says of the photographs of a capture.

    Args:
        path: of the file.
        images: the folder of the photographs; None: where the file has them.
        given: whether the file was given itself, not its folder.

    Raises InputError that names file and field.
    """
    read = read_frames(path, given)
    folder, places = _photographs(path, images, [frame.name for frame in read.frames])
    places = readable(places, folder)
    frames = [frame for frame in read.frames if frame.name in places]
    shots, scales = [], []
    for frame in frames:
        pose, scale = _world_to_camera(frame.where, frame.fields)
        shots.append(_shot(frame.where, path.parent, frame.fields, *places[frame.name], pose))
        scales.append(scale)
    say_scales(path, scales)
    _say_angles(path, list(zip(frames, shots)))
    held = tuple(places[frame.name][0] for frame in frames if frame.is_held)
    return Shots(
        path,
        folder,
        shots,
        *_points(path, read.data.get("ply_file_path"), read.data.get("applied_transform"), shots),
        held,
        read.held_by,
    )


def _photographs(path: Path, images: Path | None, names: list[str]) -> tuple[Path, Places]:
    """The folder of images, and by the names of the photographs their names in it and their files. Missing ones are
    not there, which is said."""
    common = _common([PurePosixPath(name).parent for name in names])
    inner = {name: PurePosixPath(name).relative_to(common).as_posix() if common else name for name in names}
    if images is not None:
        found = photographs_in([images], list(inner.values()))
        return found.folder, {name: found.places[inner[name]] for name in names if inner[name] in found.places}
    known: Places = {}
    for name in names:
        try:
            known[name] = inner[name], named_image("file_path", path.parent, name)
        except InputError as error:
            if not any(words in str(error) for words in ("missing image", "leads out")):
                raise InputError(f"{path}: {error}") from None
    if len(known) == len(names):
        return path.parent / common, known
    found = photographs_in([path.parent / "images", path.parent], names, known)
    if known:
        return path.parent / common, {name: (inner[name], file) for name, (_, file) in found.places.items()}
    folder = found.folder / _common([PurePosixPath(within).parent for within, _ in found.places.values()])
    return folder, {name: (file.relative_to(folder).as_posix(), file) for name, (_, file) in found.places.items()}


def _common(folders: list[PurePosixPath]) -> str:
    """The folder that all of these lie in; none where only some begin at the root."""
    if len({folder.is_absolute() for folder in folders}) > 1:
        return ""
    return os.path.commonpath(folders)


def _shot(where: str, folder: Path, fields: dict[str, Any], name: str, photo: Path, pose: np.ndarray) -> Shot:
    def number(key: str) -> float | None:
        is_angle = key.startswith("camera_angle")
        low, high = (1e-6, 3.14159) if is_angle else (-1e12, 1e12)
        what = f"{where}.{key}{', radians,' if is_angle else ''}"
        return None if fields.get(key) is None else real_number(what, fields[key], low, high)

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
    return Shot(name, photo, pose, intrinsics, size, _lens(where, fields, number), mask)


def _say_angles(path: Path, pairs: Sequence[tuple[Frame, Shot]]) -> None:
    """Says of which frames camera_angle_x is another than that of fl_x, which is what counts."""
    off = []
    for frame, shot in pairs:
        angle = 2 * math.atan(shot.camera_px[0] / 2 / shot.intrinsics[0])
        given = frame.fields.get("camera_angle_x")
        if isinstance(given, (int, float)) and abs(given - angle) > _ANGLES_DIFFER * angle:
            off.append((given, angle))
    if off:
        words = counted(len(off), "frame", len(pairs), "have a camera_angle_x of another focal length than fl_x")
        assume(f"{path}: {words}, {off[0][0]:.4g} and not {off[0][1]:.4g} radians: fl_x counts")


def _world_to_camera(where: str, fields: dict[str, Any]) -> tuple[np.ndarray, float]:
    """World to camera [4,4] of a frame, OpenCV axes, and the scale that its rotation was divided by."""
    where = f"{where}.transform_matrix"
    try:
        pose = np.array(fields.get("transform_matrix"))
    except ValueError:
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got rows of different lengths") from None
    if pose.shape not in ((4, 4), (3, 4)) or pose.dtype.kind not in "iuf":
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got {pose.dtype} {list(pose.shape)}")
    pose = np.concatenate([pose[:3], [[0, 0, 0, 1]]]).astype(np.float64)
    pose[:3, :3], scale = unscaled(pose[:3, :3])
    check_pose(where, pose)
    rotation = nearest_rotation((pose @ TO_OPENCV)[:3, :3]).T
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = rotation, -rotation @ pose[:3, 3]
    return inverse, scale


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


def _points(path: Path, name: Any, applied: Any, shots: Sequence[Shot]) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] and colours [P,3] uint8 of the .ply that a transforms.json names, or else of files beside it that
    have some; none where there are none.

    Args:
        path: of the file.
        name: its ply_file_path.
        applied: its applied_transform, of COLMAP's world to that of the poses.
        shots: its photographs, which a model of COLMAP beside it may have too.
    """
    if name is None:
        points, colours = points_beside(None, [path.parent])
        if not len(points) and (model := model_folder(path.parent)) is not None:
            points, colours = points_of_model(model, shots, applied)
        return points, colours
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"{path}: ply_file_path: expected the name of a .ply file beside it, got {shown(name)}")
    named = path.parent / name
    files = [named, *(path.parent / end for end in _ends(name))]
    ply = next((file for file in files if file.is_file()), None)
    if ply is None:
        raise InputError(f"{path}: ply_file_path: expected the name of a .ply file beside it, got {shown(name)}")
    if ply != named:
        assume(f"{path}: the points of ply_file_path {shown(name)} are those of {ply}, by the last parts of its name")
    return read_points(ply)


def _ends(name: str) -> list[PurePosixPath]:
    """The last parts of a path, the longest first."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return [PurePosixPath(*parts[first:]) for first in range(1 if PurePosixPath(name).is_absolute() else 0, len(parts))]
