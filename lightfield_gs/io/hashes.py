"""SHA-256 of what files hold."""

from __future__ import annotations

import hashlib
from pathlib import Path

from lightfield_gs.base.errors import reading

_CHUNK_BYTES = 1 << 20


def sha256_of(*paths: str | Path) -> str:
    """The hash of the contents of files, one after the other, hexadecimal. Raises InputError where one cannot be
    read."""
    digest = hashlib.sha256()
    for path in paths:
        with reading(path), open(path, "rb") as file:
            while chunk := file.read(_CHUNK_BYTES):
                digest.update(chunk)
    return digest.hexdigest()
