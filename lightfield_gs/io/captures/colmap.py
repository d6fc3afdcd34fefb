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
from lightfield_gs.io.captures.camera_models import lens_of
from lightfield_gs.io.captures.colmap_files import (
    ColmapCamera,
    ColmapFrame,
    ColmapImage,
    Rigs,
    is_undecoded,
    read_model_file,
)
from lightfield_gs.io.captures.photo_files import first_names, how_many_there, outside, photographs_in
from lightfield_gs.io.captures.photograph import Shot, Shots, readable
from lightfield_gs.io.captures.pinhole import nearest_rotation
from lightfield_gs.io.captures.point_files import no_points, points_beside

_SAME_POSE = 1e-6  # how far numbers of two poses may be apart, of translations in their own length
_MODELS = ("sparse/0", "sparse", "")
# What nerfstudio's and Inria's scripts worked on, and what programs export in COLMAP's form beside the photographs
_INNER_MODELS = ("colmap/sparse/0", "distorted/sparse/0", "colmap/sparse", "distorted/sparse", "colmap/0", "colmap")
_IMAGES = ("images", "input", "images_2", "images_4", "images_8", "")
# Windows' code pages that names may be of, the likeliest first: western, Japanese, Chinese, Korean, central European,
# Cyrillic, Greek, Turkish
_CODE_PAGES = ("cp1252", "cp932", "cp936", "cp950", "cp949", "cp1250", "cp1251", "cp1253", "cp1254")
_CAMERAS_OFF = 0.02  # by which cameras of one photograph may differ, of their spread, and of their axes


@dataclass(frozen=True)
class ColmapModel:
    """What a folder of model files holds.

    cameras: by their number. images: in the files' order; each has a known camera and a name of its own. points: [P,3]
    float64, world coordinates, as stored (they may not be finite); colours: [P,3] uint8.
    """

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: np.ndarray
    colours: np.ndarray


def is_model(folder: Path) -> bool:
    """Whether the files of a model are in this folder."""
    return any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_model(folder: Path) -> ColmapModel:
    """The model in a folder; without a file of points it has none. Poses that frames and rigs tell otherwise than
    images are theirs, which is said. Raises InputError that names the file."""
    cameras: dict[int, ColmapCamera] = dict(_read(folder, "cameras"))
    images = _by_frames(folder, _read(folder, "images"))
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
        points, colours = _read(folder, "points3D")
    else:
        points, colours = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    return ColmapModel(cameras, images, points, colours)


def count_photographs(folder: Path) -> int:
    """How many photographs the model in a folder has poses of. Raises InputError."""
    images: list[ColmapImage] = _read(folder, "images")
    return sum(image.world_to_camera is not None for image in images)


def _by_frames(folder: Path, images: list[ColmapImage]) -> list[ColmapImage]:
    """These photographs, with the poses that frames and rigs give them where they say others; one that no frame has
    keeps its own. Both files are of the form of images, or they are not of this model."""
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
        if image.number in poses and not _is_same(image.world_to_camera, poses[image.number])
    }
    if moved:
        assume(
            f"{folder}: the poses of {len(moved)} of {len(images)} photographs are those of frames{form} and "
            f"rigs{form}, as COLMAP reads them; images{form} has others: remove both files to take those"
        )
    return [replace(image, world_to_camera=moved.get(image.number, image.world_to_camera)) for image in images]


def _is_same(pose: np.ndarray | None, other: np.ndarray) -> bool:
    """Whether two poses [4,4] are alike up to the digits that files have."""
    return pose is not None and bool((np.abs(pose - other) <= _SAME_POSE * (1 + np.abs(other[:, 3]).max())).all())


def names_decoded(images: Sequence[ColmapImage], page: str) -> list[ColmapImage]:
    """These photographs, their names that are no UTF-8 as this code page of Windows has them, other bytes as ?."""
    return [
        replace(image, name=_decoded(image.name, page).replace("\\", "/")) if is_undecoded(image.name) else image
        for image in images
    ]


def _decoded(name: str, page: str) -> str:
    return name.encode(errors="surrogateescape").decode(page, errors="replace")


def _read(folder: Path, kind: str) -> Any:
    """What one of the three files holds: the binary one, or else the text. Raises InputError where there is neither."""
    for suffix in (".bin", ".txt"):
        if (path := folder / f"{kind}{suffix}").is_file():
            return read_model_file(path, kind)
    raise InputError(f"{folder}: missing {kind}.bin or {kind}.txt beside the other files of a COLMAP model")


def model_folder(folder: Path, inner: bool = True) -> Path | None:
    """Where below a capture's folder the model is, or the folder itself; None where there is none. inner: also where
    scripts keep the model that they made the capture from."""
    names = (*_MODELS, *_INNER_MODELS) if inner else _MODELS
    numbered = (path for name in names if name.endswith("/0") for path in _models_in((folder / name).parent))
    return next((folder / name for name in names if is_model(folder / name)), next(numbered, None))


def colmap_shots(folder: Path, images: Path | None, masks: Path | None = None) -> Shots:
    """What COLMAP says of the photographs of a capture. images: their folder; None: one of the usual names, the first
    that has them. masks: the folder of masks, if it was given. Of several models beside each other the one of the most
    photographs counts. Raises InputError."""
    model_at = model_folder(folder)
    if model_at is None:
        raise InputError(f"{folder}: expected a COLMAP model in sparse/0, sparse or the folder itself")
    if model_at != folder:
        model_at = _largest(model_at)
    model = read_model(model_at)
    roots = [folder, folder.parent, folder.parent.parent] if model_at == folder else [folder]
    folders = [images] if images else [root / name for root in roots for name in _IMAGES]
    known = _with_names(model_at, model.images, folders)
    posed = [(image, image.world_to_camera) for image in known if image.world_to_camera is not None]
    unposed = [image.name for image in known if image.world_to_camera is None]
    if not posed:
        raise InputError(f"{model_at}: expected photographs with poses, got {len(known)} without")
    found = photographs_in(folders, [image.name for image, _ in posed])
    # A folder that was not given and holds the model too has pictures of other kinds, as masks
    is_mixed = images is None and model_at.is_relative_to(found.folder)
    unknown = [] if is_mixed else outside(masks, found.folder, found.others)
    _say_what_is_left_out(model_at, [name for name in unknown if name not in unposed], unposed)
    places = readable(found.places, found.folder)
    shots = []
    for image, pose in posed:
        if image.name in places:
            camera = model.cameras[image.camera]
            lens = lens_of(camera.model, camera.coefficients)
            size = camera.width_px, camera.height_px
            shots.append(Shot(*places[image.name], pose, camera.intrinsics, size, lens))
    points, colours = model.points, model.colours
    if not len(points):
        points, colours = points_beside(model_at, [folder])
    return Shots(model_at, found.folder, shots, points, colours)


def _models_in(folder: Path) -> list[Path]:
    """The models in the folders 0, 1, ... of this one, in order of their numbers."""
    if not folder.is_dir():
        return []
    found = [path for path in folder.iterdir() if path.name.isdecimal() and is_model(path)]
    return sorted(found, key=lambda path: int(path.name))


def _largest(model: Path) -> Path:
    """The model with the most photographs of those beside this one, which is said; of as many, the first."""
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
    """How many photographs a model has; none where it cannot be read."""
    try:
        return count_photographs(model)
    except InputError:
        return 0


def _with_names(model: Path, images: Sequence[ColmapImage], folders: Sequence[Path]) -> Sequence[ColmapImage]:
    """These photographs, names that are no UTF-8 read as of the code page that most files of them are there by."""
    strange = [image for image in images if is_undecoded(image.name)]
    if not strange:
        return images
    decoded = {page: [image.name for image in names_decoded(strange, page)] for page in _CODE_PAGES}
    page = max(_CODE_PAGES, key=lambda page: how_many_there(folders, decoded[page]))  # of as many, the first
    assume(
        f"{model}: the names of {len(strange)} of {len(images)} photographs are no UTF-8 and are read as of Windows' "
        f"code page {page.removeprefix('cp')}: {first_names(decoded[page][:1])}"
    )
    return names_decoded(images, page)


def _say_what_is_left_out(model: Path, unknown: list[str], unposed: list[str]) -> None:
    if unposed:
        words = counted(len(unposed), "photograph", does="have no pose there and are left out")
        assume(f"{model}: {words}: {first_names(unposed)}")
    if unknown:
        words = counted(len(unknown), "photograph", does=f"are not in the model {model} and are left out")
        assume(f"{words}: {first_names(unknown)}")


def points_of_model(model: Path, shots: Sequence[Shot], applied: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] float64 and colours [P,3] uint8 of a model that COLMAP made of the same photographs, in the world of
    their poses; says so. None where the model has none, or its cameras do not stand as the photographs' do.

    Args:
        model: a folder of COLMAP's files.
        shots: the photographs, whose poses may be in another world than the model's.
        applied: a matrix [3,4] or [4,4] from the model's world to the poses', which counts where fewer than two
            photographs are in both; None: the worlds are the same.
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
    for shot in shots:
        stem = PurePosixPath(shot.name).with_suffix("")
        pose = whole.get(stem, last.get(stem.name) if len(last) == len(whole) else None)
        if pose is not None:
            pairs.append((pose, shot.world_to_camera))
    matrix = _similarity(*map(np.stack, zip(*pairs))) if len(pairs) >= 2 else _applied(applied)
    if matrix is None:
        assume(f"the points of the model {model} are not used: its cameras do not stand as those of the photographs do")
        return no_points()
    assume(
        f"the {len(found.points)} points are those of the model {model}, in the world of the poses by "
        f"{f'{len(pairs)} cameras that both have' if len(pairs) >= 2 else 'applied_transform'}"
    )
    return found.points @ matrix[:, :3].T + matrix[:, 3], found.colours


def _similarity(theirs: np.ndarray, ours: np.ndarray) -> np.ndarray | None:
    """The matrix [3,4], a rotation with a scale and a shift, of one world to another in which the same cameras
    [C,4,4], world to camera, are known; None where there is none."""
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


def _applied(matrix: Any) -> np.ndarray | None:
    """A matrix [3,4] of a file; None where it is none."""
    if matrix is None:
        return np.eye(3, 4)
    try:
        numbers = np.array(matrix, np.float64)
    except (ValueError, TypeError):
        return None
    return numbers[:3] if numbers.shape in ((3, 4), (4, 4)) and np.isfinite(numbers).all() else None
