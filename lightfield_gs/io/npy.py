"""Arrays of numbers from NumPy's .npy files that may be damaged."""

from __future__ import annotations

import tokenize
from pathlib import Path

import numpy as np

from lightfield_gs.errors import InputError
from lightfield_gs.io.not_what_it_says import refuse_stand_in
from lightfield_gs.paths import checked_path


def open_array(path: str | Path) -> np.ndarray:
    """The array of a .npy file, mapped, read-only. Raises InputError that names the file."""
    path = checked_path(path)
    try:
        with open(path, "rb") as file:
            start = file.read(12)
        # From version 2 on the header's length has four bytes, and as many bytes would be asked for at once
        if start[6:7] >= b"\2" and int.from_bytes(start[8:12], "little") > path.stat().st_size:
            raise ValueError("its header is longer than the file")
        # Never unpickles, and never allocates what a header claims
        array = np.lib.format.open_memmap(path, mode="r")
        if array.dtype.kind not in "biuf":
            raise ValueError(f"it holds {array.dtype}")
        return array
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, TypeError, EOFError, OverflowError, SyntaxError, tokenize.TokenError) as error:
        refuse_stand_in(path)
        raise InputError(f"{path} is not a .npy file of numbers: {' '.join(str(error).split())[:200]}") from error
