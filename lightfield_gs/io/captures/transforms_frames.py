"""The frames of a capture in a transforms.json, or in one file for each of its parts, and which it keeps for tests.

Source: nerfstudio's data conventions for train_filenames, val_filenames and test_filenames; the synthetic scenes of
Mildenhall et al., "NeRF", 2020, for transforms_train.json, transforms_val.json and transforms_test.json.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.photo_files import first_names
from lightfield_gs.io.text_files import read_object

_LIMIT_BYTES = 256 << 20
_WHOLE, _TRAIN = "transforms.json", "transforms_train.json"
_TESTS = ("transforms_test.json", "transforms_val.json")  # the first that there is holds out
_TRAIN_KEY, _TEST_KEYS = "train_filenames", ("val_filenames", "test_filenames")


@dataclass(frozen=True)
class Frame:
    """One frame that has a pose. where: its place, for messages. name: of its photograph, with / between folders.
    fields: its own, and those at the top of its file. is_held: whether it is kept for tests."""

    where: str
    name: str
    fields: dict[str, Any]
    is_held: bool = False


@dataclass(frozen=True)
class Frames:
    """What is fitted to or tested by. data: what stands at the top of the file. held_by: what keeps some for tests."""

    data: dict[str, Any]
    frames: list[Frame]
    held_by: str = ""


def transforms_file(folder: Path) -> Path | None:
    """The transforms.json of a capture, or transforms_train.json, or the file itself that was given; None where there
    is none."""
    if folder.suffix.lower() == ".json":
        return folder if folder.is_file() else None
    return next((folder / name for name in (_WHOLE, _TRAIN) if (folder / name).is_file()), None)


def has_frames(path: Path) -> bool:
    """Whether a JSON file has frames that name photographs; not one that cannot be read."""
    try:
        frames = read_object(path, _LIMIT_BYTES).get("frames")
    except InputError:
        return False
    return isinstance(frames, list) and any(isinstance(frame, dict) and "file_path" in frame for frame in frames[:1])


def read_frames(path: Path, given: bool) -> Frames:
    """The frames of a capture that a file tells of; says which are left out.

    Args:
        path: a transforms.json, or one of another name.
        given: whether it was given itself; a transforms_train.json of a folder brings its tests along.

    Raises InputError that names file and field.
    """
    data, frames = _frames(path)
    if not given and path.name == _TRAIN:
        return _with_tests(path, data, frames)
    if not given and path.name == _WHOLE and (path.parent / _TRAIN).is_file():
        assume(f"{path} is read, not {_TRAIN} beside it: give that file itself to read it")
    return _split(path, data, frames)


def _frames(path: Path) -> tuple[dict[str, Any], list[Frame]]:
    """What stands at the top of one file, and its frames that have poses."""
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
        frames.append(Frame(where, _plain(name), {**shared, **entry}))
    frames = _once(path, frames)
    posed = [frame for frame in frames if not _has_no_pose(frame.fields.get("transform_matrix"))]
    if not posed:
        raise InputError(f"{path}: frames: expected some with a pose (transform_matrix), got {len(frames)} without")
    if len(posed) < len(frames):
        there = {frame.name for frame in posed}
        lost = [frame.name for frame in frames if frame.name not in there]
        words = counted(len(lost), "frame", len(frames), "have no pose and are left out")
        assume(f"{path}: {words}: {first_names(lost)}")
    return shared, posed


def _once(path: Path, frames: list[Frame]) -> list[Frame]:
    """The frames without those that are the same as one before, which is said. Raises InputError where a photograph has
    two poses or cameras."""
    kept: dict[str, Frame] = {}
    for frame in frames:
        before = kept.setdefault(frame.name, frame)
        if _apart_from_name(before) != _apart_from_name(frame):
            raise InputError(
                f"{path}: frames: expected each photograph once, got {shown(frame.name)} twice, with different "
                "poses or cameras: take one out"
            )
    if same := len(frames) - len(kept):
        assume(f"{path}: {counted(same, 'frame', len(frames), 'are the same as one before and are left out')}")
    return list(kept.values())


def _apart_from_name(frame: Frame) -> str:
    """What a frame says but for its name, to compare: NaN is the same as NaN."""
    return repr({key: value for key, value in frame.fields.items() if key != "file_path"})


def _with_tests(path: Path, data: dict[str, Any], train: list[Frame]) -> Frames:
    """The frames to fit to, and those of the file of tests beside theirs."""
    there = [name for name in _TESTS if (path.parent / name).is_file()]
    if not there:
        return _split(path, data, train)
    held = [replace(frame, is_held=True) for frame in _frames(path.parent / there[0])[1]]
    names = {frame.name for frame in held}
    fitted = [frame for frame in train if frame.name not in names]
    if not fitted:
        raise InputError(f"{path.parent}: {there[0]} has all photographs of {_TRAIN}: expected others to test with")
    if both := len(train) - len(fitted):
        words = counted(both, "photograph", does=f"of {_TRAIN} are in {there[0]} too and are held out, not fitted to")
        assume(f"{path.parent}: {words}")
    if unused := there[1:]:
        assume(f"{path.parent}: {unused[0]} is not read: {there[0]} holds out photographs already")
    return Frames(data, [*fitted, *held], there[0])


def _split(path: Path, data: dict[str, Any], frames: list[Frame]) -> Frames:
    """The frames as the file's own lists of names part them. A list of those to fit to alone holds out the others."""
    known = {frame.name for frame in frames}
    train = known & _names(path, data, _TRAIN_KEY)
    keys = [key for key in _TEST_KEYS if data.get(key)]
    named = {name for key in keys for name in _names(path, data, key)}
    if strange := sorted((named | _names(path, data, _TRAIN_KEY)) - known):
        words = counted(len(strange), "name", does="in its lists of photographs are of no frame with a pose")
        assume(f"{path}: {words}: {first_names(strange)}")
    held = named & known if keys else known - train if train else set()
    if train and not train - held:
        held -= train  # a file may test with what it fits to
    if not held:
        return Frames(data, frames)
    left = known - train - held if train else set()
    if left:
        lists = f"in none of its lists of names ({_TRAIN_KEY}, {', '.join(keys)}) and"
        words = counted(len(left), "photograph", does=f"are {lists} are left out")
        assume(f"{path}: {words}: {first_names(sorted(left))}")
    kept = [replace(frame, is_held=frame.name in held) for frame in frames if frame.name not in left]
    return Frames(data, kept, f"{' and '.join(keys) or _TRAIN_KEY} of {path.name}")


def _names(path: Path, data: dict[str, Any], key: str) -> set[str]:
    """The names in a list of the file, none where there is no such list; raises InputError."""
    names = data.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path}: {key}: expected a list of names, got {shown(names)}")
    return {_plain(name) for name in names}


def _plain(name: str) -> str:
    """A name with / between folders, without ./ and .. in its middle."""
    return PurePosixPath(os.path.normpath(name.replace("\\", "/"))).as_posix()


def _has_no_pose(matrix: Any) -> bool:
    """Whether a matrix is none: missing, empty, or with numbers that are none, as of an app that lost its way."""
    if isinstance(matrix, list) and matrix:
        return any(_has_no_pose(entry) for entry in matrix)
    return matrix is None or matrix == [] or isinstance(matrix, float) and not math.isfinite(matrix)
