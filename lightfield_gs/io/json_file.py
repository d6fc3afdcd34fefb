"""JSON files that hold an object."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lightfield_gs.errors import InputError
from lightfield_gs.paths import checked_path


def parse_json(text: str) -> Any:
    """The value; raises ValueError where it is none, or is nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError(str(error)) from None


def read_object(path: str | Path, limit_bytes: int) -> dict[str, Any]:
    """The object in a JSON file of at most `limit_bytes`. Raises InputError that names the file."""
    path = checked_path(path)
    try:
        if path.stat().st_size > limit_bytes:
            raise InputError(f"{path}: expected at most {limit_bytes} bytes of JSON, got {path.stat().st_size}")
        data = parse_json(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path} is not JSON: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected an object {{\"key\": value}}, got {type(data).__name__}")
    return data
