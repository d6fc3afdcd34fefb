"""Captures with a transforms.json: nerfstudio's, instant-ngp's and NeRF's.

Source: nerfstudio's data conventions, also for train_filenames, val_filenames and test_filenames. Müller et al.,
"Instant Neural Graphics Primitives", 2022. The synthetic scenes of Mildenhall et al., "NeRF", 2020, for
transforms_train.json, transforms_val.json and transforms_test.json.

The fields are as in objects.py, with these differences:
    camera_model: any of COLMAP's, with its coefficients by name; is_fisheye means OPENCV_FISHEYE. Cameras may differ.
    EQUIRECTANGULAR, of 360 degrees, becomes two photographs: what lies ahead, and what lies behind.
    file_path: relative to the images folder or to one of its reduced copies. ply_file_path: points in the world of the
    poses. Without it, points are looked for beside the file. applied_transform: from COLMAP's world to the world of the
    poses; it changes neither poses nor points. depth_file_path (nerfstudio), depth_path (NeRFCapture): points where
    there are no others. The fields of a rolling shutter are in readout.py.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import (
    BROWN_COEFFICIENTS,
    COLMAP_MODELS,
    Distortion,
    describe_coefficients,
    distort_brown,
    lens_distortion,
)
from lightfield_gs.io.captures.colmap import model_folder, read_model_points
from lightfield_gs.io.captures.dataparser import find_dataparser_transform
from lightfield_gs.io.captures.depth_points import DepthFile, depth_points
from lightfield_gs.io.captures.photo_files import LocatedFiles, find_image, find_photographs, first_names
from lightfield_gs.io.captures.photograph import PosedCapture, PosedPhotograph, readable_files
from lightfield_gs.io.captures.pinhole import (
    PINHOLE_MODELS,
    TO_OPENCV,
    check_intrinsics,
    check_pose,
    focal_lengths,
    nearest_rotation,
    note_scales,
    remove_scale,
)
from lightfield_gs.io.captures.point_files import find_points, read_points
from lightfield_gs.io.captures.readout import note_readouts, read_readout
from lightfield_gs.io.images import read_info
from lightfield_gs.io.text_files import read_object

_LIMIT_BYTES = 256 << 20
_WHOLE, _TRAIN = "transforms.json", "transforms_train.json"
_TESTS = ("transforms_test.json", "transforms_val.json")  # the first that there is holds out
_TRAIN_KEY, _TEST_KEYS = "train_filenames", ("val_filenames", "test_filenames")
# Fields of a depth map, and of its unit: nerfstudio's, and those of NeRFCapture and instant-ngp
_DEPTHS = {"depth_file_path": "", "depth_path": "integer_depth_scale"}
_DEPTH_UNIT = 1e-3  # where the file tells none: millimetres
_ALL_ROUND = "EQUIRECTANGULAR"  # the camera_model of nerfstudio
_ANGLES_DIFFER = 0.02  # relative tolerance of an angle of view; distortion and rounding make less
_FURTHER = ("k5", "k6", "s1", "s2", "s3", "s4", "b1", "b2", "p3", "p4")  # fields of lenses outside PINHOLE_MODELS


@dataclass(frozen=True)
class TransformsFrame:
    """A frame that has a pose.

    Attributes:
        where: file and index, for messages.
        name: of its photograph, with / between folders.
        fields: the frame's own fields, and the fields at the top of its file.
        is_held_out: whether it is held out for tests.
    """

    where: str
    name: str
    fields: dict[str, Any]
    is_held_out: bool = False


@dataclass(frozen=True)
class TransformsFrames:
    """The frames to fit to and to test by.

    Attributes:
        data: the fields at the top of the file.
        frames: with poses.
        held_by: the field or file that holds some out for tests.
    """

    data: dict[str, Any]
    frames: list[TransformsFrame]
    held_by: str = ""


def transforms_file(folder: Path) -> Path | None:
    """Return the transforms.json or transforms_train.json of a capture, or the file that was given.

    None without one.
    """
    if folder.suffix.lower() == ".json":
        return folder if folder.is_file() else None
    return next((folder / name for name in (_WHOLE, _TRAIN) if (folder / name).is_file()), None)


def has_frames(path: Path) -> bool:
    """Return whether a JSON file has frames that name photographs; False where it cannot be read."""
    try:
        frames = read_object(path, _LIMIT_BYTES).get("frames")
    except InputError:
        return False
    return isinstance(frames, list) and any(isinstance(frame, dict) and "file_path" in frame for frame in frames[:1])


def read_frames(path: Path, given: bool) -> TransformsFrames:
    """Read the frames of a capture, with a note on frames that are left out.

    Args:
        path: a transforms.json, under any name.
        given: whether the file itself was given. The transforms_train.json of a folder brings its tests along.

    Raises:
        InputError: names file and field.
    """
    data, frames = _frames(path)
    if not given and path.name == _TRAIN:
        return _add_test_frames(path, data, frames)
    if not given and path.name == _WHOLE and (path.parent / _TRAIN).is_file():
        assume(f"{path} is read, not {_TRAIN} beside it: give that file itself to read it")
    return _split_by_names(path, data, frames)


def _frames(path: Path) -> tuple[dict[str, Any], list[TransformsFrame]]:
    """Return the fields at the top of a file, and its frames that have poses."""
    data = read_object(path, _LIMIT_BYTES)
    entries = data.get("frames")
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: frames: expected a list of views, got {shown(entries)}")
    shared = {key: value for key, value in data.items() if key != "frames"}
    frames = []
    for index, entry in enumerate(entries):
        where = f"{path}: frames[{index}]"
        name = entry.get("file_path") if isinstance(entry, dict) else None
        if not isinstance(name, str) or not name.strip() or "\0" in name:
            raise InputError(f"{where}.file_path: expected the name of an image, got {shown(name)}")
        frames.append(TransformsFrame(where, _normalised_name(name), {**shared, **entry}))
    frames = _unique_frames(path, frames)
    posed = [frame for frame in frames if not _has_no_pose(frame.fields.get("transform_matrix"))]
    if not posed:
        raise InputError(f"{path}: frames: expected some with a pose (transform_matrix), got {len(frames)} without")
    if len(posed) < len(frames):
        there = {frame.name for frame in posed}
        lost = [frame.name for frame in frames if frame.name not in there]
        words = counted(len(lost), "frame", len(frames), "have no pose and are left out")
        assume(f"{path}: {words}: {first_names(lost)}")
    return shared, posed


def _unique_frames(path: Path, frames: list[TransformsFrame]) -> list[TransformsFrame]:
    """Drop frames that repeat an earlier one, with a note.

    Raises InputError where a photograph has two poses or cameras.
    """
    unique: dict[str, TransformsFrame] = {}
    for frame in frames:
        before = unique.setdefault(frame.name, frame)
        if _fields_key(before) != _fields_key(frame):
            raise InputError(
                f"{path}: frames: expected each photograph once, got {shown(frame.name)} twice, with different "
                "poses or cameras: take one out"
            )
    if same := len(frames) - len(unique):
        assume(f"{path}: {counted(same, 'frame', len(frames), 'are the same as one before and are left out')}")
    return list(unique.values())


def _fields_key(frame: TransformsFrame) -> str:
    """Return the fields of a frame except its name, in a form in which NaN equals NaN."""
    return repr({key: value for key, value in frame.fields.items() if key != "file_path"})


def _add_test_frames(path: Path, data: dict[str, Any], train: list[TransformsFrame]) -> TransformsFrames:
    """Return the frames to fit to, and the frames of the test file beside their file."""
    there = [name for name in _TESTS if (path.parent / name).is_file()]
    if not there:
        return _split_by_names(path, data, train)
    held_out = [replace(frame, is_held_out=True) for frame in _frames(path.parent / there[0])[1]]
    names = {frame.name for frame in held_out}
    fitted = [frame for frame in train if frame.name not in names]
    if not fitted:
        raise InputError(f"{path.parent}: {there[0]} has all photographs of {_TRAIN}: expected others to test with")
    if both := len(train) - len(fitted):
        words = counted(both, "photograph", does=f"of {_TRAIN} are in {there[0]} too and are held out, not fitted to")
        assume(f"{path.parent}: {words}")
    if unused := there[1:]:
        assume(f"{path.parent}: {unused[0]} is not read: {there[0]} holds out photographs already")
    return TransformsFrames(data, [*fitted, *held_out], there[0])


def _split_by_names(path: Path, data: dict[str, Any], frames: list[TransformsFrame]) -> TransformsFrames:
    """Split the frames by the file's own lists of names. A train list alone holds out all others."""
    known = {frame.name for frame in frames}
    train = known & _names(path, data, _TRAIN_KEY)
    keys = [key for key in _TEST_KEYS if data.get(key)]
    named = {name for key in keys for name in _names(path, data, key)}
    if strange := sorted((named | _names(path, data, _TRAIN_KEY)) - known):
        words = counted(len(strange), "name", does="in its lists of photographs are of no frame with a pose")
        assume(f"{path}: {words}: {first_names(strange)}")
    held_out = named & known if keys else known - train if train else set()
    if train and not train - held_out:
        held_out -= train  # a file may test with photographs that it fits to
    if not held_out:
        return TransformsFrames(data, frames)
    left = known - train - held_out if train else set()
    if left:
        lists = f"in none of its lists of names ({_TRAIN_KEY}, {', '.join(keys)}) and"
        words = counted(len(left), "photograph", does=f"are {lists} are left out")
        assume(f"{path}: {words}: {first_names(sorted(left))}")
    selected = [replace(frame, is_held_out=frame.name in held_out) for frame in frames if frame.name not in left]
    return TransformsFrames(data, selected, f"{' and '.join(keys) or _TRAIN_KEY} of {path.name}")


def _names(path: Path, data: dict[str, Any], key: str) -> set[str]:
    """Return the names in a list of the file; none where there is no such list. Raises InputError."""
    names = data.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path}: {key}: expected a list of names, got {shown(names)}")
    return {_normalised_name(name) for name in names}


def _normalised_name(name: str) -> str:
    """Return a name with / between folders, without ./ and inner .."""
    return PurePosixPath(os.path.normpath(name.replace("\\", "/"))).as_posix()


def _has_no_pose(matrix: Any) -> bool:
    """Return whether a matrix is missing, empty or not finite, as of an app that lost tracking."""
    if isinstance(matrix, list) and matrix:
        return any(_has_no_pose(entry) for entry in matrix)
    return matrix is None or matrix == [] or isinstance(matrix, float) and not math.isfinite(matrix)


def read_transforms_capture(path: Path, images: Path | None, given: bool) -> PosedCapture:
    """Read the posed photographs of a transforms.json.

    Args:
        path: the file.
        images: the folder of the photographs; None: as the file names them.
        given: whether the file itself was given, not its folder.

    Raises:
        InputError: names file and field.
    """
    read = read_frames(path, given)
    folder, files = _find_photographs(path, images, [frame.name for frame in read.frames])
    files = readable_files(files, folder)
    frames = [frame for frame in read.frames if frame.name in files]
    posed, scales = [], []
    for frame in frames:
        pose, scale = _world_to_camera(frame.where, frame.fields)
        posed.append(_posed_photograph(frame.where, path.parent, frame.fields, *files[frame.name], pose))
        scales.append(scale)
    note_scales(path, scales)
    _note_angles(path, list(zip(frames, posed)))
    note_readouts(path, [frame.fields for frame in frames], posed)
    held_out = tuple(files[frame.name][0] for frame in frames if frame.is_held_out)
    points, colours = _points(path, read.data.get("ply_file_path"), read.data.get("applied_transform"), posed)
    if not len(points):
        points, colours = depth_points(posed, _depth_files(path, dict(zip((one.name for one in posed), frames))))
    if (moved := find_dataparser_transform(path)) is not None:
        posed = [
            replace(one, world_to_camera=moved.pose(one.world_to_camera), readout=moved.readout(one.readout))
            for one in posed
        ]
        points = moved.points(points)
    behind = [_behind(one) for one in posed if one.half is not None]
    held_out += tuple(map(_behind_name, held_out)) if behind else ()
    return PosedCapture(path, folder, [*posed, *behind], points, colours, held_out, read.held_by)


def _depth_files(path: Path, frames: dict[str, TransformsFrame]) -> dict[str, DepthFile]:
    """Return the depth maps that frames name, by their photographs' names: nerfstudio's, and NeRFCapture's."""
    files = {}
    for name, frame in frames.items():
        for key, unit_key in _DEPTHS.items():
            value = frame.fields.get(key)
            file = path.parent / value if isinstance(value, str) and "\0" not in value else None
            if file is not None and file.is_file():
                unit = real_number(f"{frame.where}.{unit_key}", frame.fields.get(unit_key, _DEPTH_UNIT), 1e-12, 1e12)
                files[name] = DepthFile(file, unit)
    return files


def _find_photographs(path: Path, images: Path | None, names: list[str]) -> tuple[Path, LocatedFiles]:
    """Return the folder of images, and the files of the photographs by their names; missing ones are noted."""
    common = _common_folder([PurePosixPath(name).parent for name in names])
    inner = {name: PurePosixPath(name).relative_to(common).as_posix() if common else name for name in names}
    if images is not None:
        found = find_photographs([images], list(inner.values()))
        return found.folder, {name: found.files[inner[name]] for name in names if inner[name] in found.files}
    known: LocatedFiles = {}
    for name in names:
        try:
            known[name] = inner[name], find_image("file_path", path.parent, name)
        except InputError as error:
            if not any(words in str(error) for words in ("missing image", "leads out")):
                raise InputError(f"{path}: {error}") from None
    if len(known) == len(names):
        return path.parent / common, known
    found = find_photographs([path.parent / "images", path.parent], names, known)
    if known:
        return path.parent / common, {name: (inner[name], file) for name, (_, file) in found.files.items()}
    folder = found.folder / _common_folder([PurePosixPath(within).parent for within, _ in found.files.values()])
    return folder, {name: (file.relative_to(folder).as_posix(), file) for name, (_, file) in found.files.items()}


def _common_folder(folders: list[PurePosixPath]) -> str:
    """Return the folder that contains all of these; "" where only some are absolute."""
    if len({folder.is_absolute() for folder in folders}) > 1:
        return ""
    return os.path.commonpath(folders)


def _posed_photograph(
    where: str, folder: Path, fields: dict[str, Any], name: str, photo: Path, pose: np.ndarray
) -> PosedPhotograph:
    def number(key: str) -> float | None:
        is_angle = key.startswith("camera_angle")
        low, high = (1e-6, 3.14159) if is_angle else (-1e12, 1e12)
        what = f"{where}.{key}{', radians,' if is_angle else ''}"
        return None if fields.get(key) is None else real_number(what, fields[key], low, high)

    width, height = number("w"), number("h")
    if width is None or height is None:
        info = read_info(photo)
        width, height = float(info.width_px), float(info.height_px)
    mask = None
    if fields.get("mask_path") is not None:
        mask = find_image(f"{where}.mask_path", folder, fields["mask_path"])
    if fields.get("camera_model") == _ALL_ROUND:
        if width % 4 or width != 2 * height:
            raise InputError(
                f"{where}: expected an equirectangular photograph of 360 x 180 degrees, with a multiple of 4 columns "
                f"and half as many rows, got {width:g} x {height:g}"
            )
        per_radian = width / math.tau
        intrinsics = np.array([per_radian, per_radian, width / 4, height / 2])
        return PosedPhotograph(name, photo, pose, intrinsics, (int(width) // 2, int(height)), None, mask, half="ahead")
    focal = focal_lengths(number, width, height)
    if focal is None:
        raise InputError(f"{where}: missing focal length: give fl_x (pixels) or camera_angle_x (radians)")
    cx, cy = number("cx"), number("cy")
    intrinsics = np.array([*focal, width / 2 if cx is None else cx, height / 2 if cy is None else cy])
    check_intrinsics(where, intrinsics, width, height)
    size = int(width), int(height)
    readout = read_readout(where, fields)
    return PosedPhotograph(name, photo, pose, intrinsics, size, _lens(where, fields, number), mask, readout=readout)


def _behind(ahead: PosedPhotograph) -> PosedPhotograph:
    """Return the half of an equirectangular photograph that its other half leaves out."""
    turned = np.diag([-1.0, 1, -1, 1]) @ ahead.world_to_camera
    return replace(ahead, name=_behind_name(ahead.name), world_to_camera=turned, half="behind")


def _behind_name(name: str) -> str:
    return f"{name} (behind)"


def _note_angles(path: Path, pairs: Sequence[tuple[TransformsFrame, PosedPhotograph]]) -> None:
    """Note frames whose camera_angle_x contradicts fl_x, which counts."""
    off = []
    for frame, photograph in pairs:
        if photograph.half is not None:
            continue
        angle = 2 * math.atan(photograph.camera_px[0] / 2 / photograph.intrinsics[0])
        given = frame.fields.get("camera_angle_x")
        if isinstance(given, (int, float)) and abs(given - angle) > _ANGLES_DIFFER * angle:
            off.append((given, angle))
    if off:
        words = counted(len(off), "frame", len(pairs), "have a camera_angle_x of another focal length than fl_x")
        assume(f"{path}: {words}, {off[0][0]:.4g} and not {off[0][1]:.4g} radians: fl_x counts")


def _world_to_camera(where: str, fields: dict[str, Any]) -> tuple[np.ndarray, float]:
    """Return world to camera [4,4] of a frame, OpenCV axes, and the scale that its rotation was divided by."""
    where = f"{where}.transform_matrix"
    try:
        pose = np.array(fields.get("transform_matrix"))
    except ValueError:
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got rows of different lengths") from None
    if pose.shape not in ((4, 4), (3, 4)) or pose.dtype.kind not in "iuf":
        raise InputError(f"{where}: expected 4 rows of 4 numbers, got {pose.dtype} {list(pose.shape)}")
    pose = np.concatenate([pose[:3], [[0, 0, 0, 1]]]).astype(np.float64)
    pose[:3, :3], scale = remove_scale(pose[:3, :3])
    check_pose(where, pose)
    rotation = nearest_rotation((pose @ TO_OPENCV)[:3, :3]).T
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = rotation, -rotation @ pose[:3, 3]
    return inverse, scale


def _lens(where: str, fields: dict[str, Any], number: Callable[[str], float | None]) -> Distortion | None:
    model = "OPENCV_FISHEYE" if fields.get("is_fisheye") is True else fields.get("camera_model") or "PINHOLE"
    if model in PINHOLE_MODELS:
        if unknown := [key for key in _FURTHER if number(key)]:
            raise InputError(
                f"{where}.{unknown[0]}: expected a lens of {', '.join(BROWN_COEFFICIENTS)} alone with the camera_model "
                f"{model}, got {shown(fields[unknown[0]])}"
            )
        coefficients = tuple(number(key) or 0.0 for key in BROWN_COEFFICIENTS)
        text = describe_coefficients(np.array(coefficients))
        return Distortion(_brown, coefficients, f"{model} {text}") if any(coefficients) else None
    if model not in COLMAP_MODELS:
        raise InputError(
            f"{where}.camera_model: expected one of {', '.join(COLMAP_MODELS)}, got {shown(model)}: make perspective "
            "photographs of these first"
        )
    keys = [("k1" if key == "k" else key) for key in COLMAP_MODELS[model].coefficients]
    return lens_distortion(model, [number(key) or 0.0 for key in keys])


def _brown(points: np.ndarray, *coefficients: float) -> np.ndarray:
    return distort_brown(points, np.array(coefficients))


def _points(path: Path, name: Any, applied: Any, posed: Sequence[PosedPhotograph]) -> tuple[np.ndarray, np.ndarray]:
    """Read the points of a transforms.json: from ply_file_path, or else from files beside it.

    Args:
        path: the file.
        name: its ply_file_path, or None.
        applied: its applied_transform, from COLMAP's world to the world of the poses.
        posed: its photographs, which a COLMAP model beside it may have too.

    Returns:
        Points [P,3] and colours [P,3] uint8.
    """
    if name is None:
        points, colours = find_points(None, [path.parent])
        if not len(points) and (model := model_folder(path.parent)) is not None:
            points, colours = read_model_points(model, posed, applied)
        return points, colours
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"{path}: ply_file_path: expected the name of a .ply file beside it, got {shown(name)}")
    named = path.parent / name
    files = [named, *(path.parent / end for end in _path_suffixes(name))]
    ply = next((file for file in files if file.is_file()), None)
    if ply is None:
        raise InputError(f"{path}: ply_file_path: expected the name of a .ply file beside it, got {shown(name)}")
    if ply != named:
        assume(f"{path}: the points of ply_file_path {shown(name)} are those of {ply}, by the last parts of its name")
    return read_points(ply)


def _path_suffixes(name: str) -> list[PurePosixPath]:
    """Return the last parts of a path, the longest first."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return [PurePosixPath(*parts[first:]) for first in range(1 if PurePosixPath(name).is_absolute() else 0, len(parts))]
