"""What files hold, as hashes, and a quick sign that they may have changed."""

from __future__ import annotations

import hashlib
import os
from functools import lru_cache
from pathlib import Path
from stat import S_ISDIR
from typing import Any

from lightfield_gs.base.errors import reading
from lightfield_gs.io.atomic import sha256


def stamp(path: str | Path) -> list[int]:
    """Size in bytes and time of the last change, ns; of a folder the sum, the latest, and how many files are in it.

    A file whose stamp is what it was is taken to hold what it held. Raises InputError where there is none.
    """
    with reading(path):
        own = os.stat(path)
        if not S_ISDIR(own.st_mode):
            return [own.st_size, own.st_mtime_ns]
        found = [file.stat() for file in _files(Path(path))]
    return [sum(file.st_size for file in found), max((file.st_mtime_ns for file in found), default=0), len(found)]


def facts(path: str | Path) -> dict[str, Any]:
    """The stamp and the SHA-256 of a file; of a folder that of the names and the hashes of all files in it. Raises
    InputError."""
    found = stamp(path)  # before it is read: what is changed meanwhile is found changed the next time
    return {"stamp": found, "sha256": _digest(os.path.abspath(path), tuple(found))}


@lru_cache(maxsize=64)  # a rig or a checkpoint is an input of every item
def _digest(path: str, version: tuple[int, ...]) -> str:
    with reading(path):
        if not os.path.isdir(path):
            return sha256(path)
        lines = [f"{sha256(file)} {file.relative_to(path).as_posix()}\n" for file in _files(Path(path))]
    return hashlib.sha256("".join(lines).encode("utf-8", "surrogateescape")).hexdigest()


def _files(folder: Path) -> list[Path]:
    """All files in a folder and below, in the order of their names."""
    return sorted(file for file in folder.rglob("*") if file.is_file())
