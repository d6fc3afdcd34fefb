"""Photographs for calibration as files: three (or one) from each place, with where that is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import expect, is_row, shown
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.images import read_image
from lightfield_gs.io.text_files import check_keys, read_mapping
from lightfield_gs.panels.calibration_photos import Place

Corners = Sequence[Sequence[float]]


def read_places(path: str | Path) -> list[Place]:
    """The places of a YAML file (at most 64 KiB), with their photographs, whose names are relative to it:

        places:
          - eye_mm: [0, 0, 600]
            photos: [left-0.jpg, left-1.jpg, left-2.jpg]
            corners_px: [[92, 61], [694, 90], [668, 452], [121, 428]]    # may be left out

    Raises InputError that names the file.
    """
    path = Path(path)
    listed = read_mapping(path, ("places",), ())["places"]
    if not is_row(listed):
        raise InputError(f"{path}: places must be a list, got {shown(listed)}")
    return [_place(path, number, entry) for number, entry in enumerate(listed)]


def _place(path: Path, number: int, entry: object) -> Place:
    where = f"{path}: places[{number}]"
    if not isinstance(entry, dict):
        raise InputError(f"{where}: expected eye_mm, photos and perhaps corners_px, got {shown(entry)}")
    check_keys(entry, ("eye_mm", "photos"), ("corners_px",), where)
    eye, photos, corners = entry["eye_mm"], entry["photos"], entry.get("corners_px")
    if not is_row(photos) or not all(isinstance(photo, str) for photo in photos):
        raise InputError(f"{where}: photos must be a list of file names, got {shown(photos)}")
    if not is_row(eye, 3):
        raise InputError(f"{where}: eye_mm must be x, y, z, got {shown(eye)}")
    if corners is not None and not is_row(corners, 4):
        raise InputError(f"{where}: corners_px must be four pairs x, y, got {shown(corners)}")
    with named(where):
        return load_place([path.parent / photo for photo in photos], tuple(eye), corners)


def load_place(
    photos: Sequence[str | Path], eye_mm: tuple[float, float, float], corners_px: Corners | None = None
) -> Place:
    """A place by the files of its photographs (see Place), which are turned upright and taken for sRGB.

    Raises InputError.
    """
    expect("eye_mm", eye_mm, tuple)
    pictures = tuple(_colours(read_image(photo, as_stored=True)) for photo in photos)
    names = " ".join(Path(photo).name for photo in photos)
    return Place(eye_mm, pictures, corners_px, name=names[:80])


def _colours(pixels: np.ndarray) -> np.ndarray:
    """[H, W, 3] of an image of any channels."""
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, 2)
