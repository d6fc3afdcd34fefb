"""Compressed data, unpacked no further than a file of its size can honestly need: no bomb fills the memory."""

from __future__ import annotations

import importlib
import zlib
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError

ALWAYS_BYTES = 1 << 24  # what may come out of a file of any size: some hundred thousand Gaussians
MOST_RATIO = 64  # scenes shrink by 1.2 to 10; only blank ones by more
_GZIP = 31  # zlib's number for a gzip header and the largest window


def check_promise(path: Path, promised_bytes: int, stored_bytes: int) -> None:
    """Raises InputError where so few stored bytes cannot be that much data, before any memory is taken for it."""
    if promised_bytes > max(ALWAYS_BYTES, MOST_RATIO * stored_bytes):
        raise InputError(
            f"{path}: {promised_bytes} bytes are promised by {stored_bytes} compressed ones, more than "
            f"{MOST_RATIO} to one; it is cut, or its counts are wrong"
        )


def gunzip(path: Path, data: bytes, most_bytes: int) -> bytes:
    """The first `most_bytes` (or all, where there are fewer) of gzip data. Raises InputError where it is broken."""
    try:
        return zlib.decompressobj(_GZIP).decompress(data, most_bytes)
    except zlib.error as error:
        raise InputError(f"{path}: its gzip data are broken ({error}); download or export it again") from None


def _zstd() -> Any:
    """Python's module for zstd (3.14), or its backport for those before."""
    for name in ("compression.zstd", "backports.zstd"):
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise InputError(
        "files of SPZ version 4 are compressed by zstd, which this Python lacks; pip install 'lightfield-gs[spz]', or "
        "export the file as SPZ version 3 or .ply"
    )


def unzstd(path: Path, data: bytes, size_bytes: int) -> bytes:
    """zstd data of exactly `size_bytes`. Raises InputError where it is broken, of another size, or zstd lacks."""
    zstd = _zstd()
    try:
        unpacked = zstd.ZstdDecompressor().decompress(data, size_bytes + 1)
    except (zstd.ZstdError, EOFError, ValueError, MemoryError) as error:
        words = " ".join(str(error).split())[:100]
        raise InputError(f"{path}: its zstd data are broken ({words}); download or export it again") from None
    if len(unpacked) != size_bytes:
        raise InputError(
            f"{path}: a stream holds {'more' if len(unpacked) > size_bytes else len(unpacked)} bytes where "
            f"{size_bytes} were expected; it is cut or its header is wrong"
        )
    return unpacked
