"""What files of Gaussians hold, as arrays: one reader for each format, chosen by the file's extension."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.scenes import ply
from lightfield_gs.io.scenes.ply_data import read_elements
from lightfield_gs.io.scenes.ply_header import HEADER_LIMIT_BYTES, read_header


@dataclass
class StoredScene:
    """A scene as arrays.

    fields: the five fields of N >= 1 Gaussians by name, float32 [N, ...]; see scene/gaussians.py. origin: where the
    zero of their means lies in the file's coordinates. comments, elements, notes: see scene/files.py.
    """

    fields: dict[str, np.ndarray]
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    comments: tuple[str, ...] = ()
    elements: dict[str, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def _read_ply(path: Path, skip_invalid: bool) -> StoredScene:
    with open(path, "rb") as file:
        header = read_header(path, file.read(HEADER_LIMIT_BYTES))
    ply.check_header(path, header)
    elements = read_elements(path, header)
    fields, origin, notes = ply.fields_of(path, elements.pop("vertex"), skip_invalid)
    return StoredScene(fields, origin, header.comments, elements, notes)


# By extension; files of any other are taken for .ply, and say so themselves where they are none.
READERS: dict[str, Callable[[Path, bool], StoredScene]] = {".ply": _read_ply}
_UNREAD = {".spz": "SPZ", ".splat": "splat", ".ksplat": "ksplat", ".sog": "SOG", ".json": "SOG or JSON"}


def read_stored(path: str | Path, *, skip_invalid: bool = False) -> StoredScene:
    """Reads a file of Gaussians; see scene/files.py. Raises InputError."""
    expect("skip_invalid", skip_invalid, bool)
    path = checked_path(path)
    suffix = path.suffix.lower()
    if suffix in _UNREAD:
        raise InputError(
            f"{path}: {_UNREAD[suffix]} files are not supported in this version; convert it to a standard 3DGS .ply"
        )
    with reading(path):
        return READERS.get(suffix, _read_ply)(path, skip_invalid)
