"""Reader of the NeRF layout: a transforms.json beside the images of one object.

Source of the layout: Mildenhall et al., "NeRF", ECCV 2020; Müller et al., "Instant Neural Graphics Primitives", 2022.
frames: for each view an object with file_path (relative to the JSON, extension optional) and transform_matrix (4x4,
camera-to-world, OpenGL axes: x right, y up, z backward). The camera, at the top or in a frame, which has precedence:
    w, h                                whole pixels; default: the size of the first image
    fl_x, fl_y                          pixels; or camera_angle_x, camera_angle_y, radians: w / 2 / tan(angle / 2);
                                        the one that is missing equals the other (square pixels)
    cx, cy                              pixels from the outer corner of the first pixel; default: the middle
    k1 k2 k3 k4 p1 p2                   lens distortion (lens.py), taken out of the images when they are read; the
                                        camera stays the same: fl_x ... cy are those of the undistorted image, too
    camera_model                        one of MODELS; fisheyes and others are refused
and mask_path, likewise an image for each frame, white where the object is. Without it, masks are looked for in masks/
(masks.py). File names may have \\ between folders, and another case than the files.
Everything else (aabb_scale, scale, offset, ...) is about other programs and is not read.

The unit of length of such files is arbitrary; poses stay as the file has them.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.checks import counted, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.files import named_image
from lightfield_gs.io.captures.lens import COEFFICIENTS, check_distortion
from lightfield_gs.io.captures.masks import masks_beside
from lightfield_gs.io.captures.pinhole import MODELS, TO_OPENCV, focal_lengths, say_scales, unscaled
from lightfield_gs.io.captures.views import ObjectViews, check_intrinsics, check_looking_at_object, check_pose
from lightfield_gs.io.images import read_info
from lightfield_gs.io.text_files import read_object as read_json

_LIMIT_BYTES = 64 << 20
_FISHEYE = ("is_fisheye", "fisheye")
_OTHER_COEFFICIENTS = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "p3", "p4")
_AXES = "OpenGL axes, x right, y up, z backward: from OpenCV axes, negate the second and third column of each rotation"


def read_transforms(path: Path) -> ObjectViews:
    """Read the cameras of a transforms file, and find its images (not decoded here).

    Raises InputError that names file and field of the first thing wrong.
    """
    path = Path(path)
    data = read_json(path, _LIMIT_BYTES)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: expected a list of views, got {shown(frames)}")
    fields = [f"{path}: frames[{index}]" for index in range(len(frames))]
    for field, frame in zip(fields, frames):
        if not isinstance(frame, dict):
            raise InputError(f"{field}: expected an object with file_path and transform_matrix, got {shown(frame)}")
    images = [
        named_image(f"{field}.file_path", path.parent, frame.get("file_path")) for field, frame in zip(fields, frames)
    ]
    found, scales = zip(*(_pose(f"{field}.transform_matrix", frame) for field, frame in zip(fields, frames)))
    say_scales(path, scales)
    poses = np.stack(found)
    check_looking_at_object(f"{path}: transform_matrix", poses, _AXES)
    sizes, intrinsics, lenses = zip(*(_camera(field, data, frame, images[0]) for field, frame in zip(fields, frames)))
    for field, size in zip(fields, sizes):
        if size != sizes[0]:
            raise InputError(
                f"{field}: bad intrinsics: expected the size of frames[0], {sizes[0][0]} x {sizes[0][1]}, "
                f"got w x h of {size[0]} x {size[1]}; resize the images to one size"
            )
    masks = _masks(fields, frames, path.parent, images)
    width, height = sizes[0]
    return ObjectViews(
        path.parent.name,
        tuple(images),
        poses,
        np.stack(intrinsics),
        width,
        height,
        f"{path}: w, h",
        masks,
        np.stack(lenses) if np.any(lenses) else None,
    )


def _masks(
    fields: list[str], frames: list[dict[str, Any]], folder: Path, images: list[Path]
) -> tuple[Path, ...] | None:
    """The mask of each frame: what mask_path names, or else what lies in masks/; None where there is neither."""
    given = [frame.get("mask_path") is not None for frame in frames]
    if not any(given):
        return masks_beside(folder, images)
    if not all(given):
        raise InputError(
            f"{fields[given.index(False)]}: missing mask_path: "
            f"{counted(sum(given), 'frame', len(frames), 'have')} one; give each frame one, or none"
        )
    return tuple(named_image(f"{field}.mask_path", folder, frame["mask_path"]) for field, frame in zip(fields, frames))


def _pose(field: str, frame: dict[str, Any]) -> tuple[np.ndarray, float]:
    """The camera-to-world matrix of a frame, float64 [4,4], OpenCV axes, and the scale that it was divided by."""
    try:
        pose = np.array(frame.get("transform_matrix"))
    except ValueError:
        raise InputError(f"{field}: bad pose: expected 4 rows of 4 numbers, got rows of different lengths") from None
    if pose.shape != (4, 4) or pose.dtype.kind not in "iuf":
        raise InputError(f"{field}: bad pose: expected 4 rows of 4 numbers, got {pose.dtype} {list(pose.shape)}")
    pose = pose.astype(np.float64)
    pose[:3, :3], scale = unscaled(pose[:3, :3])
    check_pose(field, pose)
    return pose @ TO_OPENCV, scale


def _camera(
    field: str, shared: dict[str, Any], frame: dict[str, Any], first_image: Path
) -> tuple[tuple[int, int], np.ndarray, np.ndarray]:
    """Image size (w, h), (fx, fy, cx, cy) and lens distortion of a frame; what it does not say is shared by all."""

    def number(key: str) -> float | None:
        value = frame.get(key, shared.get(key))
        if value is None:
            return None
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) < 1e12:
            raise InputError(f"{field}: {key}: expected a number, got {shown(value)}")
        if key.startswith("camera_angle") and not 0 < value < math.pi:
            raise InputError(f"{field}: bad intrinsics: {key}: expected 0 to pi radians, got {value:g}")
        return value

    _check_model(field, {**shared, **frame})
    width, height = number("w"), number("h")
    if width is None or height is None:
        info = read_info(first_image)
        width, height = info.width_px if width is None else width, info.height_px if height is None else height
    found = focal_lengths(number, width, height)
    if found is None:
        raise InputError(
            f"{field}: bad intrinsics: missing focal length: give fl_x (pixels) or camera_angle_x (radians)"
        )
    cx, cy = number("cx"), number("cy")
    intrinsics = np.array([*found, width / 2 if cx is None else cx, height / 2 if cy is None else cy], np.float64)
    check_intrinsics(field, intrinsics, width, height)
    lens = np.array([number(key) or 0 for key in COEFFICIENTS], np.float64)
    if lens.any():
        check_distortion(field, intrinsics, lens, int(width), int(height))
    return (int(width), int(height)), intrinsics, lens


def _check_model(field: str, camera: dict[str, Any]) -> None:
    """Raises InputError for a camera that this reader cannot draw, by its model's name or further coefficients."""
    model = camera.get("camera_model") or "PINHOLE"
    fisheye = [key for key in _FISHEYE if camera.get(key)]
    if model not in MODELS or fisheye:
        raise InputError(
            f"{field}: bad intrinsics: camera_model: expected one of {', '.join(MODELS)}, got "
            f"{fisheye[0] if fisheye else shown(model)}: undistort the images first"
        )
    if unknown := [key for key in _OTHER_COEFFICIENTS if camera.get(key)]:
        raise InputError(
            f"{field}: bad intrinsics: {unknown[0]}: expected a lens of {', '.join(COEFFICIENTS)} alone, "
            f"got {shown(camera[unknown[0]])}: undistort the images first"
        )
