"""Captures with a COLMAP model: its poses, its points and the folder of its photographs.

Source: COLMAP's documentation, "Output Format". The model is in sparse/0, in sparse or in the folder itself. Binary
files win over text files. Since version 4 a model has the files rigs and frames; where their poses differ from those
in images, COLMAP reads rigs and frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import lens_distortion
from lightfield_gs.io.captures.colmap_files import (
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    Rigs,
    is_undecoded,
    read_model_file,
)
from lightfield_gs.io.captures.photo_files import count_found, find_photographs, first_names, names_outside
from lightfield_gs.io.captures.photograph import PosedCapture, PosedPhotograph, readable_files
from lightfield_gs.io.captures.pinhole import nearest_rotation
from lightfield_gs.io.captures.point_files import find_points, no_points

_SAME_POSE = 1e-6  # tolerance of two equal poses; of translations, relative to their length
_MODELS = ("sparse/0", "sparse", "")
# Input folders of nerfstudio's and Inria's scripts, and folders of exported COLMAP files
_INNER_MODELS = ("colmap/sparse/0", "distorted/sparse/0", "colmap/sparse", "distorted/sparse", "colmap/0", "colmap")
_IMAGES = ("images", "input", "images_2", "images_4", "images_8", "")
# Code pages of Windows, the likeliest first: western, Japanese, Chinese, Korean, central European, Cyrillic, Greek,
# Turkish
_CODE_PAGES = ("cp1252", "cp932", "cp936", "cp950", "cp949", "cp1250", "cp1251", "cp1253", "cp1254")
_CAMERAS_OFF = 0.02  # tolerance of camera centres, relative to their spread, and of camera axes


@dataclass(frozen=True)
class ColmapModel:
    """The contents of a model folder.

    Attributes:
        cameras: by id.
        images: in the file's order. Each has a known camera and a unique name.
        points: [P,3] float64, world coordinates as stored; they may not be finite.
        colours: [P,3] uint8.
    """

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: np.ndarray
    colours: np.ndarray


def is_model(folder: Path) -> bool:
    """Return whether a folder holds the files of a model."""
    return any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_model(folder: Path) -> ColmapModel:
    """Read the model in a folder.

    If frames and rigs have other poses than images, the poses of frames and rigs are taken, with a note. Without a file
    of points the model has none.

    Raises:
        InputError: names the file.
    """
    cameras: dict[int, ColmapCamera] = dict(_read_kind(folder, "cameras"))
    images = _poses_from_frames(folder, _read_kind(folder, "images"))
    where = f"{folder}: images"
    if not images:
        raise InputError(f"{where}: expected photographs with poses, got none: COLMAP registered none")
    seen: set[str] = set()
    for image in images:
        if image.camera not in cameras:
            raise InputError(
                f"{where}: {shown(image.name)}: expected a camera of the file cameras, got number {image.camera}"
            )
        if image.name in seen:
            raise InputError(f"{where}: expected each photograph once, got {shown(image.name)} twice")
        seen.add(image.name)
    if any((folder / f"points3D{suffix}").is_file() for suffix in (".bin", ".txt")):
        points, colours = _read_kind(folder, "points3D")
    else:
        points, colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return ColmapModel(cameras, images, points, colours)


def count_photographs(folder: Path) -> int:
    """Return the number of posed photographs of the model in a folder. Raises InputError."""
    images: list[ColmapImage] = _read_kind(folder, "images")
    return sum(image.world_to_camera is not None for image in images)


def _poses_from_frames(folder: Path, images: list[ColmapImage]) -> list[ColmapImage]:
    """Replace the poses of images by the poses of frames and rigs, where these differ.

    An image without a frame keeps its pose. Rigs and frames count only in the form, binary or text, of images.
    """
    form = ".bin" if (folder / "images.bin").is_file() else ".txt"
    paths = [folder / f"{kind}{form}" for kind in ("rigs", "frames")]
    if not all(path.is_file() for path in paths):
        return images
    rigs: Rigs = read_model_file(paths[0], "rigs")
    frames: list[ColmapFrame] = read_model_file(paths[1], "frames")
    poses = {}
    for frame in frames:
        for sensor, image in frame.images.items():
            from_rig = rigs.get(frame.rig, {}).get(sensor)
            if frame.world_to_rig is not None and from_rig is not None:
                poses[image] = from_rig @ frame.world_to_rig
    moved = {
        image.number: poses[image.number]
        for image in images
        if image.number in poses and not _is_same_pose(image.world_to_camera, poses[image.number])
    }
    if moved:
        assume(
            f"{folder}: the poses of {len(moved)} of {len(images)} photographs are those of frames{form} and "
            f"rigs{form}, as COLMAP reads them; images{form} has others: remove both files to take those"
        )
    return [replace(image, world_to_camera=moved.get(image.number, image.world_to_camera)) for image in images]


def _is_same_pose(pose: np.ndarray | None, other: np.ndarray) -> bool:
    """Return whether two poses [4,4] are equal up to the digits of files."""
    return pose is not None and bool((np.abs(pose - other) <= _SAME_POSE * (1 + np.abs(other[:, 3]).max())).all())


def decode_names(images: Sequence[ColmapImage], page: str) -> list[ColmapImage]:
    """Decode the names that are no UTF-8 by this code page of Windows; other bytes become "?"."""
    return [
        replace(image, name=_decode(image.name, page).replace("\\", "/")) if is_undecoded(image.name) else image
        for image in images
    ]


def _decode(name: str, page: str) -> str:
    return name.encode(errors="surrogateescape").decode(page, errors="replace")


def _read_kind(folder: Path, kind: str) -> Any:
    """Read one file of a model, binary if there is one, else text. Raises InputError where there is neither."""
    for suffix in (".bin", ".txt"):
        if (path := folder / f"{kind}{suffix}").is_file():
            return read_model_file(path, kind)
    raise InputError(f"{folder}: missing {kind}.bin or {kind}.txt beside the other files of a COLMAP model")


def model_folder(folder: Path, inner: bool = True) -> Path | None:
    """Return the model's folder below a capture's folder, or that folder itself; None where there is none.

    Args:
        folder: the capture's folder.
        inner: whether to look also where scripts keep the model that they made the capture from.
    """
    names = (*_MODELS, *_INNER_MODELS) if inner else _MODELS
    numbered = (path for name in names if name.endswith("/0") for path in _models_in((folder / name).parent))
    return next((folder / name for name in names if is_model(folder / name)), next(numbered, None))


def read_colmap_capture(folder: Path, images: Path | None, masks: Path | None = None) -> PosedCapture:
    """Read the posed photographs of a capture with a COLMAP model.

    Of several models beside each other the model with the most photographs is read.

    Args:
        folder: the capture's folder.
        images: the folder of the photographs; None: the first of the usual names that has them.
        masks: the folder of masks, if one was given.

    Raises:
        InputError: names the missing or wrong file.
    """
    model_at = model_folder(folder)
    if model_at is None:
        raise InputError(f"{folder}: expected a COLMAP model in sparse/0, sparse or the folder itself")
    if model_at != folder:
        model_at = _largest_model(model_at)
    model = read_model(model_at)
    roots = [folder, folder.parent, folder.parent.parent] if model_at == folder else [folder]
    folders = [images] if images else [root / name for root in roots for name in _IMAGES]
    known = _decode_image_names(model_at, model.images, folders)
    posed = [(image, image.world_to_camera) for image in known if image.world_to_camera is not None]
    unposed = [image.name for image in known if image.world_to_camera is None]
    if not posed:
        raise InputError(f"{model_at}: expected photographs with poses, got {len(known)} without")
    found = find_photographs(folders, [image.name for image, _ in posed])
    # A folder that also holds the model has other images, such as masks
    is_mixed = images is None and model_at.is_relative_to(found.folder)
    unknown = [] if is_mixed else names_outside(masks, found.folder, found.others)
    _note_left_out(model_at, [name for name in unknown if name not in unposed], unposed)
    files = readable_files(found.files, found.folder)
    photographs = []
    for image, pose in posed:
        if image.name in files:
            camera = model.cameras[image.camera]
            distortion = lens_distortion(camera.model, camera.coefficients)
            size = camera.width_px, camera.height_px
            photographs.append(PosedPhotograph(*files[image.name], pose, camera.intrinsics, size, distortion))
    points, colours = model.points, model.colours
    if not len(points):
        points, colours = find_points(model_at, [folder])
    return PosedCapture(model_at, found.folder, photographs, points, colours)


def _models_in(folder: Path) -> list[Path]:
    """Return the models in the folders 0, 1, ... of a folder, in order of their numbers."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if path.name.isdecimal() and is_model(path)]
    return sorted(found, key=lambda path: int(path.name))


def _largest_model(model: Path) -> Path:
    """Return the model with the most photographs among those beside this one, with a note; the first of equals."""
    models = _models_in(model.parent) if model.name.isdecimal() else []
    if len(models) < 2:
        return model
    counts = {path: _count(path) for path in models}
    best = max(models, key=lambda path: counts[path])
    others = [f"{path.name} of {counts[path]}" for path in models if path != best]
    assume(
        f"the model {best} of {counted(counts[best], 'photograph')} is read, not {first_names(others)} beside it: "
        "give one's own folder to choose it"
    )
    return best


def _count(model: Path) -> int:
    """Return the number of posed photographs of a model; 0 where it cannot be read."""
    try:
        return count_photographs(model)
    except InputError:
        return 0


def _decode_image_names(model: Path, images: Sequence[ColmapImage], folders: Sequence[Path]) -> Sequence[ColmapImage]:
    """Decode names that are no UTF-8 by the code page under which most of the files are found."""
    strange = [image for image in images if is_undecoded(image.name)]
    if not strange:
        return images
    decoded = {page: [image.name for image in decode_names(strange, page)] for page in _CODE_PAGES}
    page = max(_CODE_PAGES, key=lambda page: count_found(folders, decoded[page]))  # the first of equals
    assume(
        f"{model}: the names of {len(strange)} of {len(images)} photographs are no UTF-8 and are read as of Windows' "
        f"code page {page.removeprefix('cp')}: {first_names(decoded[page][:1])}"
    )
    return decode_names(images, page)


def _note_left_out(model: Path, unknown: list[str], unposed: list[str]) -> None:
    if unposed:
        words = counted(len(unposed), "photograph", does="have no pose there and are left out")
        assume(f"{model}: {words}: {first_names(unposed)}")
    if unknown:
        words = counted(len(unknown), "photograph", does=f"are not in the model {model} and are left out")
        assume(f"{words}: {first_names(unknown)}")


def read_model_points(
    model: Path, photographs: Sequence[PosedPhotograph], applied: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Read the points of a COLMAP model of the same photographs, moved to the world of their poses, with a note.

    Args:
        model: a folder of COLMAP's files.
        photographs: the photographs, whose poses may be in another world than the model's.
        applied: a matrix [3,4] or [4,4] from the model's world to the poses'; None: the worlds are the same. It counts
            where fewer than two photographs are in both.

    Returns:
        Points [P,3] float64 and colours [P,3] uint8. P is 0 where the model has none, or where its cameras do not
            stand
        as the photographs' do.
    """
    try:
        found = read_model(model)
    except InputError as error:
        assume(f"points of the model beside the photographs are not used: {error}")
        return no_points()
    if not len(found.points):
        return no_points()
    whole = {PurePosixPath(image.name).with_suffix(""): image.world_to_camera for image in found.images}
    last = {stem.name: pose for stem, pose in whole.items()}
    pairs = []
    for photograph in photographs:
        stem = PurePosixPath(photograph.name).with_suffix("")
        pose = whole.get(stem, last.get(stem.name) if len(last) == len(whole) else None)
        if pose is not None:
            pairs.append((pose, photograph.world_to_camera))
    matrix = _similarity_transform(*map(np.stack, zip(*pairs))) if len(pairs) >= 2 else _applied_transform(applied)
    if matrix is None:
        assume(f"the points of the model {model} are not used: its cameras do not stand as those of the photographs do")
        return no_points()
    assume(
        f"the {len(found.points)} points are those of the model {model}, in the world of the poses by "
        f"{f'{len(pairs)} cameras that both have' if len(pairs) >= 2 else 'applied_transform'}"
    )
    return found.points @ matrix[:, :3].T + matrix[:, 3], found.colours


def _similarity_transform(theirs: np.ndarray, ours: np.ndarray) -> np.ndarray | None:
    """Return the similarity [3,4] between two worlds in which the same cameras are known; None where there is none.

    Args:
        theirs, ours: world to camera, [C,4,4].
    """
    turns = ours[:, :3, :3].swapaxes(1, 2) @ theirs[:, :3, :3]
    turn = nearest_rotation(turns.sum(0))
    before, after = (-(pose[:, :3, :3].swapaxes(1, 2) @ pose[:, :3, 3:])[..., 0] for pose in (theirs, ours))
    moved = (before - before.mean(0)) @ turn.T
    spread = after - after.mean(0)
    size = float((moved**2).sum())
    scale = float((moved * spread).sum()) / size if size > 0 else 0.0
    off = np.abs(scale * moved - spread).max()
    if not scale > 0 or off > _CAMERAS_OFF * np.abs(spread).max() or np.abs(turns - turn).max() > _CAMERAS_OFF:
        return None
    return np.column_stack([scale * turn, after.mean(0) - scale * turn @ before.mean(0)])


def _applied_transform(matrix: Any) -> np.ndarray | None:
    """Return a matrix [3,4] of a file; the identity for None, and None where the value is no matrix."""
    if matrix is None:
        return np.eye(3, 4)
    try:
        numbers = np.array(matrix, np.float64)
    except (ValueError, TypeError):
        return None
    return numbers[:3] if numbers.shape in ((3, 4), (4, 4)) and np.isfinite(numbers).all() else None
