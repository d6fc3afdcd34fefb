r"""Readers of data sets of single objects: the NeRF layout (transforms.json) and the SRN layout.

NeRF layout, source: Mildenhall et al., "NeRF", ECCV 2020; Müller et al., "Instant Neural Graphics Primitives", 2022.
frames: for each image an object with file_path (relative to the JSON, extension optional) and transform_matrix (4x4,
camera to world, OpenGL axes: x right, y up, z backward). The camera, at the top or in a frame, which has precedence:

    w, h                      whole pixels; default: the size of the first image
    fl_x, fl_y                pixels; or camera_angle_x, camera_angle_y, radians: w / 2 / tan(angle / 2);
                              a missing one equals the other (square pixels)
    cx, cy                    pixels from the outer corner of the first pixel; default: the middle
    k1 k2 k3 k4 p1 p2         lens distortion by Brown's polynomial; images are undistorted when they are read,
                              and fl_x ... cy also hold for the undistorted image
    camera_model              one of PINHOLE_MODELS; fisheyes and others are refused
    mask_path                 a mask image of a frame, white on the object; default: masks/ (masks.py)

File names may have \ between folders, and another case than the files. Other keys (aabb_scale, scale, offset, ...)
are not read. The unit of length is arbitrary; poses stay as the file has them.

SRN layout, source: Sitzmann et al., "Scene Representation Networks", NeurIPS 2019. A folder for each object with rgb/,
pose/ and intrinsics.txt. pose/<name>.txt holds 16 numbers, the camera-to-world matrix by rows, OpenCV axes.
intrinsics.txt holds lines: "focal cx cy 0", the grid's barycentre, a near plane or scale, "height width" and,
optionally, a 1 for world-to-camera poses. Focal lengths and centres are in pixels of that height and width.

All poses here are camera to world, OpenCV axes (x right, y down, z forward), and act on column vectors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.checks import counted, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import BROWN_COEFFICIENTS
from lightfield_gs.io.captures.masks import find_object_masks
from lightfield_gs.io.captures.photo_files import IMAGE_SUFFIXES, find_image, is_hidden
from lightfield_gs.io.captures.pinhole import (
    PINHOLE_MODELS,
    TO_OPENCV,
    check_intrinsics,
    check_pose,
    focal_lengths,
    note_scales,
    remove_scale,
)
from lightfield_gs.io.captures.undistortion import check_distortion
from lightfield_gs.io.images import read_info
from lightfield_gs.io.text_files import read_object

_LIMIT_BYTES = 64 << 20
_FISHEYE = ("is_fisheye", "fisheye")
_OTHER_COEFFICIENTS = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "p3", "p4")
_NEGATE = "negate the second and third column of each rotation"
_OPENGL_AXES = f"OpenGL axes, x right, y up, z backward: from OpenCV axes, {_NEGATE}"
PARTS = ("rgb", "pose", "intrinsics.txt")
_OPENCV_AXES = f"OpenCV axes, x right, y down, z forward: from OpenGL axes, {_NEGATE}"


@dataclass(frozen=True)
class ObjectImages:
    """V images of one object with their cameras, all of one size.

    Attributes:
        name: of the object.
        image_paths: V files.
        camera_to_world: [V,4,4] float64, OpenCV axes.
        intrinsics: [V,4] float64, (fx, fy, cx, cy) in pixels of the images as stored, whatever their Exif orientation.
        width_px, height_px: size of the images.
        size_field: the file and field of that size, for messages.
        mask_paths: V files; None: no masks.
        distortion: [V,6] float64 of the stored images, in the order of BROWN_COEFFICIENTS; None: none.
    """

    name: str
    image_paths: tuple[Path, ...]
    camera_to_world: np.ndarray
    intrinsics: np.ndarray
    width_px: int
    height_px: int
    size_field: str
    mask_paths: tuple[Path, ...] | None = None
    distortion: np.ndarray | None = None


def point_looked_at(camera_to_world: np.ndarray) -> np.ndarray:
    """Return the point [3] nearest to all optical axes (least squares.

    The mean camera distance where they are parallel).
    """
    positions, directions = camera_to_world[:, :3, 3], camera_to_world[:, :3, 2]
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    return np.linalg.lstsq(across.sum(0), (across @ positions[:, :, None]).sum(0)[:, 0], rcond=1e-6)[0]


def object_depths(camera_to_world: np.ndarray) -> np.ndarray:
    """Return the depth [V] of the point looked at in each camera, scene units; negative behind it."""
    towards = point_looked_at(camera_to_world) - camera_to_world[:, :3, 3]
    return (towards * camera_to_world[:, :3, 2]).sum(-1)


def check_looking_at_object(where: str, camera_to_world: np.ndarray, expected: str) -> None:
    """Raise InputError when the cameras look away from the point in which their axes meet.

    Args:
        where: the file and field, for the message.
        camera_to_world: [V,4,4].
        expected: the axes of the layout, and how other axes are converted.
    """
    if len(camera_to_world) > 1 and (object_depths(camera_to_world) < 0).mean() > 0.5:
        raise InputError(f"{where}: wrong handedness: the cameras look away from the object; expected {expected}")


def read_nerf_object(path: Path) -> ObjectImages:
    """Read the cameras of a transforms file, and find its images, which are not decoded here.

    Raises:
        InputError: names file and field of the first mistake.
    """
    path = Path(path)
    data = read_object(path, _LIMIT_BYTES)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: expected a list of views, got {shown(frames)}")
    fields = [f"{path}: frames[{index}]" for index in range(len(frames))]
    for field, frame in zip(fields, frames):
        if not isinstance(frame, dict):
            raise InputError(f"{field}: expected an object with file_path and transform_matrix, got {shown(frame)}")
    images = [
        find_image(f"{field}.file_path", path.parent, frame.get("file_path")) for field, frame in zip(fields, frames)
    ]
    found, scales = zip(*(_pose(f"{field}.transform_matrix", frame) for field, frame in zip(fields, frames)))
    note_scales(path, scales)
    poses = np.stack(found)
    check_looking_at_object(f"{path}: transform_matrix", poses, _OPENGL_AXES)
    sizes, intrinsics, distortions = zip(
        *(_camera(field, data, frame, images[0]) for field, frame in zip(fields, frames))
    )
    for field, size in zip(fields, sizes):
        if size != sizes[0]:
            raise InputError(
                f"{field}: bad intrinsics: expected the size of frames[0], {sizes[0][0]} x {sizes[0][1]}, "
                f"got w x h of {size[0]} x {size[1]}; resize the images to one size"
            )
    masks = _masks(fields, frames, path.parent, images)
    width, height = sizes[0]
    return ObjectImages(
        path.parent.name,
        tuple(images),
        poses,
        np.stack(intrinsics),
        width,
        height,
        f"{path}: w, h",
        masks,
        np.stack(distortions) if np.any(distortions) else None,
    )


def _masks(
    fields: list[str], frames: list[dict[str, Any]], folder: Path, images: list[Path]
) -> tuple[Path, ...] | None:
    """Return the mask of each frame, by mask_path or else in masks/; None where there is neither."""
    given = [frame.get("mask_path") is not None for frame in frames]
    if not any(given):
        return find_object_masks(folder, images)
    if not all(given):
        raise InputError(
            f"{fields[given.index(False)]}: missing mask_path: "
            f"{counted(sum(given), 'frame', len(frames), 'have')} one; give each frame one, or none"
        )
    return tuple(find_image(f"{field}.mask_path", folder, frame["mask_path"]) for field, frame in zip(fields, frames))


def _pose(field: str, frame: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Return camera to world [4,4] float64 of a frame, OpenCV axes, and the scale of its rotation in the file."""
    try:
        pose = np.array(frame.get("transform_matrix"))
    except ValueError:
        raise InputError(f"{field}: bad pose: expected 4 rows of 4 numbers, got rows of different lengths") from None
    if pose.shape != (4, 4) or pose.dtype.kind not in "iuf":
        raise InputError(f"{field}: bad pose: expected 4 rows of 4 numbers, got {pose.dtype} {list(pose.shape)}")
    pose = pose.astype(np.float64)
    pose[:3, :3], scale = remove_scale(pose[:3, :3])
    check_pose(field, pose)
    return pose @ TO_OPENCV, scale


def _camera(
    field: str, shared: dict[str, Any], frame: dict[str, Any], first_image: Path
) -> tuple[tuple[int, int], np.ndarray, np.ndarray]:
    """Return image size (w, h), (fx, fy, cx, cy) and distortion of a frame.

    Fields at the top of the file are its defaults.
    """

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
    distortion = np.array([number(key) or 0 for key in BROWN_COEFFICIENTS], np.float64)
    if distortion.any():
        check_distortion(field, intrinsics, distortion, int(width), int(height))
    return (int(width), int(height)), intrinsics, distortion


def _check_model(field: str, camera: dict[str, Any]) -> None:
    """Raise InputError for a camera that this reader cannot undistort, by its model's name or further coefficients."""
    model = camera.get("camera_model") or "PINHOLE"
    fisheye = [key for key in _FISHEYE if camera.get(key)]
    if model not in PINHOLE_MODELS or fisheye:
        raise InputError(
            f"{field}: bad intrinsics: camera_model: expected one of {', '.join(PINHOLE_MODELS)}, got "
            f"{fisheye[0] if fisheye else shown(model)}: undistort the images first"
        )
    if unknown := [key for key in _OTHER_COEFFICIENTS if camera.get(key)]:
        raise InputError(
            f"{field}: bad intrinsics: {unknown[0]}: expected a lens of {', '.join(BROWN_COEFFICIENTS)} alone, "
            f"got {shown(camera[unknown[0]])}: undistort the images first"
        )


@dataclass(frozen=True)
class SrnIntrinsics:
    """Camera of an intrinsics.txt: focal length and principal point in pixels of a width_px x height_px image."""

    focal_px: float
    centre_x_px: float
    centre_y_px: float
    width_px: int
    height_px: int
    poses_are_world_to_camera: bool = False


def _numbers(path: Path) -> list[list[float]]:
    """Read all numbers of a text file, line by line without empty lines. Raises InputError."""
    try:
        text = path.read_text(encoding="utf-8-sig")
        return [[float(word) for word in line.split()] for line in text.splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path}: expected lines of numbers, but {str(error)[:100]}") from None


def read_intrinsics(path: Path) -> SrnIntrinsics:
    """Read an intrinsics.txt. Raises InputError when a line is missing or its numbers make no camera."""
    lines = _numbers(path)
    if len(lines) < 4 or len(lines[0]) < 3 or len(lines[3]) != 2:
        raise InputError(f'{path}: bad intrinsics: expected lines "focal cx cy 0", barycentre, scale, "height width"')
    focal, centre_x, centre_y = lines[0][:3]
    height, width = lines[3]
    check_intrinsics(str(path), np.array([focal, focal, centre_x, centre_y]), width, height)
    inverted = len(lines) > 4 and bool(lines[4][0])
    return SrnIntrinsics(focal, centre_x, centre_y, int(width), int(height), inverted)


def read_pose(path: Path) -> np.ndarray:
    """Read a pose file as a 4x4 float64 matrix. Raises InputError unless it is a proper rigid motion."""
    values = [value for line in _numbers(path) for value in line]
    if len(values) != 16:
        raise InputError(f"{path}: bad pose: expected 16 numbers, got {len(values)}")
    pose = np.array(values, dtype=np.float64).reshape(4, 4)
    check_pose(str(path), pose)
    return pose


def _paired_files(folder: Path) -> list[tuple[Path, Path]]:
    """Return each image with the pose file of its name. Raises InputError that names files without a partner."""
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


def read_srn_object(folder: Path) -> ObjectImages:
    """Read poses and intrinsics of an object's folder, and find its images, which are not decoded here.

    Raises:
        InputError: names the first mistake: missing parts, bad intrinsics, bad or missing poses, handedness.
    """
    folder = Path(folder)
    pairs = _paired_files(folder)
    camera = read_intrinsics(folder / "intrinsics.txt")
    poses = np.stack([read_pose(pose) for _, pose in pairs])
    if camera.poses_are_world_to_camera:
        poses = np.linalg.inv(poses)
    check_looking_at_object(f"{folder}/pose", poses, _OPENCV_AXES)
    row = (camera.focal_px, camera.focal_px, camera.centre_x_px, camera.centre_y_px)
    images = [image for image, _ in pairs]
    return ObjectImages(
        folder.name,
        tuple(images),
        poses,
        np.tile(row, (len(poses), 1)),
        camera.width_px,
        camera.height_px,
        f"{folder / 'intrinsics.txt'}: height width",
        find_object_masks(folder, images),
    )
