"""Arrays of numbers from NumPy's .npy and .npz files, which may be damaged."""

from __future__ import annotations

import io
import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.file_kinds import refuse_stand_in

_PARSE_ERRORS = (ValueError, TypeError, EOFError, OverflowError, SyntaxError, tokenize.TokenError)
_ZIP_ERRORS = (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, struct.error, KeyError)
_HEADER_BYTES = 1 << 14  # read for an array's header in an archive; shape and type take a hundred
# Limits of an array's size in memory: a multiple of its stored size, or bytes. Deflate reaches 1030
_MOST_EXPANSION, _SMALL_BYTES, _MOST_BYTES = 2000, 64 << 20, 1 << 31


def open_array(path: str | Path) -> np.ndarray:
    """Map the array of a .npy file read-only; raise InputError with the file's name."""
    path = checked_path(path)
    try:
        with open(path, "rb") as file:
            start = file.read(12)
        # From version 2 on the header's length has four bytes, and NumPy allocates it at once
        if start[6:7] >= b"\2" and int.from_bytes(start[8:12], "little") > path.stat().st_size:
            raise ValueError("its header is longer than the file")
        # open_memmap never unpickles, and never allocates what a header claims
        array = np.lib.format.open_memmap(path, mode="r")
        if array.dtype.kind not in "biuf":
            raise ValueError(f"it holds {array.dtype}")
        return array
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except _PARSE_ERRORS as error:
        refuse_stand_in(path)
        raise InputError(f"{path} is not a .npy file of numbers: {' '.join(str(error).split())[:200]}") from error


@dataclass(frozen=True)
class StoredArray:
    """An array in a .npz file that has not been read yet."""

    path: Path
    entry: zipfile.ZipInfo
    shape: tuple[int, ...]
    dtype: np.dtype
    fortran_order: bool
    data_start: int

    def read(self) -> np.ndarray:
        """Read the array; raise InputError with the file's name."""
        size = math.prod(self.shape) * self.dtype.itemsize
        allowed = min(_MOST_BYTES, max(_SMALL_BYTES, _MOST_EXPANSION * self.entry.compress_size))
        if self.dtype.kind not in "biuf" or size > allowed or self.data_start + size != self.entry.file_size:
            raise InputError(f"{self.path}: '{self.entry.filename[:80]}' is damaged, too large, or holds no numbers")
        try:
            with zipfile.ZipFile(self.path) as archive, archive.open(self.entry) as file:
                values = np.frombuffer(file.read(self.entry.file_size), self.dtype, offset=self.data_start)
                return values.reshape(self.shape, order="F" if self.fortran_order else "C")
        except (OSError, *_PARSE_ERRORS, *_ZIP_ERRORS) as error:
            raise _damage_error(self.path, error) from error


def stored_arrays(path: str | Path) -> dict[str, StoredArray]:
    """List the arrays of a .npz file by name; raise InputError with the file's name."""
    path = checked_path(path)
    found = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                if not entry.filename.endswith(".npy"):
                    continue
                with archive.open(entry) as file:
                    start = io.BytesIO(file.read(_HEADER_BYTES))
                version = np.lib.format.read_magic(start)
                read_header = {
                    (1, 0): np.lib.format.read_array_header_1_0,
                    (2, 0): np.lib.format.read_array_header_2_0,
                }[version]
                found[entry.filename[:-4]] = _stored(path, entry, start, read_header)
    except FileNotFoundError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except (OSError, *_PARSE_ERRORS, *_ZIP_ERRORS) as error:
        raise _damage_error(path, error) from error
    return found


def _stored(path: Path, entry: zipfile.ZipInfo, start: io.BytesIO, read_header: Callable[..., Any]) -> StoredArray:
    shape, fortran_order, dtype = read_header(start)
    return StoredArray(path, entry, shape, dtype, fortran_order, start.tell())


def _damage_error(path: Path, error: BaseException) -> InputError:
    return InputError(f"{path} is not a .npz file of numbers: {' '.join(str(error).split())[:200]}")
