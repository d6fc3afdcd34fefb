"""Models of COLMAP: cameras, poses of photographs and points, from its binary or its text files.

Source: COLMAP's documentation, "Output Format". cameras, images and points3D with .bin or .txt, in one folder; where
there are both kinds, the binary ones are read. The files rigs and frames that newer versions write beside them say
nothing more about single photographs. Tracks and observations are skipped.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError, named, reading
from lightfield_gs.io.captures.colmap_binary import binary_cameras, binary_images, binary_points
from lightfield_gs.io.captures.colmap_records import ColmapCamera, ColmapImage
from lightfield_gs.io.captures.colmap_text import text_cameras, text_images, text_points
from lightfield_gs.io.text_file import read_text

_LIMIT_BYTES = 8 << 30
_BINARY = {"cameras": binary_cameras, "images": binary_images, "points3D": binary_points}
_TEXT = {"cameras": text_cameras, "images": text_images, "points3D": text_points}


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
    """The model in a folder; without a file of points it has none. Raises InputError that names the file."""
    cameras: dict[int, ColmapCamera] = dict(_read(folder, "cameras"))
    images: list[ColmapImage] = _read(folder, "images")
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


def _read(folder: Path, kind: str) -> Any:
    """What one of the three files holds: the binary one, or else the text. Raises InputError where there is neither."""
    for suffix in (".bin", ".txt"):
        if (path := folder / f"{kind}{suffix}").is_file():
            return read_model_file(path, kind)
    raise InputError(f"{folder}: missing {kind}.bin or {kind}.txt beside the other files of a COLMAP model")


def read_model_file(path: Path, kind: str) -> Any:
    """What a file of `kind` (cameras, images or points3D) holds, by its suffix, as the functions of colmap_binary and
    colmap_text give it. Raises InputError that names the file."""
    if path.suffix == ".txt":
        text = read_text(path, _LIMIT_BYTES, "text of a COLMAP model")
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
