"""Text as editors and shells of every system save it."""

from __future__ import annotations

import json
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.not_what_it_says import refuse_stand_in


def read_text(path: str | Path, limit_bytes: int, kind: str, errors: str = "strict") -> str:
    """The text in a file of at most `limit_bytes`: UTF-8, UTF-16 or UTF-32, with or without a byte-order mark.

    kind: of file, for messages. errors: what becomes of bytes that are none of these, as str.decode has it. Raises
    InputError that names the file.
    """
    path = checked_path(path)
    refuse_stand_in(path)
    try:
        size = path.stat().st_size
        if size > limit_bytes:
            raise InputError(f"{path}: expected at most {limit_bytes} bytes of {kind}, got {size}")
        return decoded(path.read_bytes(), errors)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path} is not {kind}: {' '.join(str(error).split())[:200]}") from error


def decoded(data: bytes, errors: str = "strict") -> str:
    """Bytes as text, by their byte-order mark or, without one, by where the first characters have zeros: JSON and YAML
    begin with ASCII (RFC 4627, section 3). Raises ValueError where they are no text."""
    return data.decode(json.detect_encoding(data), errors)
