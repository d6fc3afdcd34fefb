"""JSON files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.text_file import read_text


def parse_json(text: str) -> Any:
    """The value; raises ValueError where it is none, or is nested too deeply."""
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError(str(error)) from None


def read_json(path: str | Path, limit_bytes: int) -> Any:
    """The value in a JSON file of at most `limit_bytes`. Raises InputError that names the file."""
    text = read_text(path, limit_bytes, "JSON")
    try:
        return parse_json(text)
    except ValueError as error:
        raise InputError(f"{path} is not JSON: {' '.join(str(error).split())[:200]}") from error


def read_object(path: str | Path, limit_bytes: int) -> dict[str, Any]:
    """The object in a JSON file of at most `limit_bytes`. Raises InputError that names the file."""
    data = read_json(path, limit_bytes)
    if not isinstance(data, dict):
        raise InputError(f'{path}: expected an object {{"key": value}}, got {type(data).__name__}')
    return data


def write_json(data: Any, path: str | Path) -> None:
    """Writes data as JSON, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
