"""Models of COLMAP: cameras, poses of photographs and points, from its binary or its text files.

Source: COLMAP's documentation, "Output Format". cameras, images and points3D with .bin or .txt, in one folder; where
there are both kinds, the binary ones are read. Since version 4 the files rigs and frames beside them say where the
photographs were taken, and COLMAP itself believes these, not the poses in images. Tracks and observations are skipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError, named, reading
from lightfield_gs.io.captures.colmap_binary import (
    binary_cameras,
    binary_frames,
    binary_images,
    binary_points,
    binary_rigs,
)
from lightfield_gs.io.captures.colmap_records import ColmapCamera, ColmapFrame, ColmapImage, Rigs, is_undecoded
from lightfield_gs.io.captures.colmap_text import text_cameras, text_frames, text_images, text_points, text_rigs
from lightfield_gs.io.text_files import read_text

_LIMIT_BYTES = 8 << 30
_SAME_POSE = 1e-6  # how far numbers of two poses may be apart, of translations in their own length
_BINARY = {
    "cameras": binary_cameras,
    "images": binary_images,
    "points3D": binary_points,
    "rigs": binary_rigs,
    "frames": binary_frames,
}
_TEXT = {
    "cameras": text_cameras,
    "images": text_images,
    "points3D": text_points,
    "rigs": text_rigs,
    "frames": text_frames,
}


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


def read_model_file(path: Path, kind: str) -> Any:
    """What a file of `kind` (cameras, images, points3D, rigs or frames) holds, by its suffix, as the functions of
    colmap_binary and colmap_text give it. Raises InputError that names the file."""
    if path.suffix == ".txt":
        text = read_text(path, _LIMIT_BYTES, "text of a COLMAP model", errors="surrogateescape")
        if not text.strip():  # even a model of nothing has its comments
            raise InputError(f"{path} is empty: copy the model again")
        with named(path):
            return _TEXT[kind](text)
    with reading(path):
        if path.stat().st_size > _LIMIT_BYTES:
            raise InputError(f"{path}: expected at most {_LIMIT_BYTES} bytes, got {path.stat().st_size}")
        data = path.read_bytes()
    with named(path):
        return _BINARY[kind](data)
