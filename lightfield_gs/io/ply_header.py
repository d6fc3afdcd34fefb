"""The text header of a .ply file, read with distrust."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.errors import InputError

_HEADER_LIMIT_BYTES = 1 << 16
_TYPES = {"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2", "ushort": "<u2",
          "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4", "float": "<f4",
          "float32": "<f4", "double": "<f8", "float64": "<f8"}


@dataclass
class Element:
    """One element of the header: its record as a packed NumPy dtype, or None where it has lists (unknown size)."""

    name: str
    count: int
    dtype: np.dtype | None


@dataclass
class Header:
    """Elements in file order, and the length of the header in bytes."""

    elements: list[Element]
    size_bytes: int


def read_header(path: Path, start: bytes) -> Header:
    """Parses the first bytes of a binary little-endian .ply.

    Raises InputError when it is another kind of file, another .ply format, or a malformed header.
    """
    start = start[:_HEADER_LIMIT_BYTES]
    if start[:4] not in (b"ply\n", b"ply\r"):
        raise InputError(f"{path} is not a .ply file: it does not begin with 'ply'")
    end = start.find(b"end_header")
    newline = start.find(b"\n", end)
    if end < 0 or newline < 0:
        raise InputError(f"{path}: no end_header in the first {_HEADER_LIMIT_BYTES} bytes; the file is cut or damaged")
    try:
        lines = start[:end].decode("ascii").splitlines()[1:]
    except UnicodeDecodeError:
        raise InputError(f"{path}: the header has bytes that are not ASCII; the file is damaged") from None
    return Header(_elements(path, lines), newline + 1)


def _elements(path: Path, lines: list[str]) -> list[Element]:
    found: list[tuple[str, int, list[tuple[str, str]] | None]] = []
    file_format = None
    for line in lines:
        words = line.split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", kind, _]:
                file_format = kind
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 32:
                found.append((name, int(count), []))
            case ["property", "list", _, _, _] if found:
                found[-1] = (*found[-1][:2], None)
            case ["property", kind, name] if found and kind in _TYPES:
                if found[-1][2] is not None:
                    found[-1][2].append((name, _TYPES[kind]))
            case _:
                raise InputError(f"{path}: cannot read the header line {line[:80]!r}")
    if file_format != "binary_little_endian":
        raise InputError(f"{path}: expected format binary_little_endian, got {(file_format or 'none')[:60]}; "
                         "export it as a binary little-endian .ply")
    return [Element(name, count, _record(path, name, properties)) for name, count, properties in found]


def _record(path: Path, element: str, properties: list[tuple[str, str]] | None) -> np.dtype | None:
    if properties is None:
        return None
    names = [name for name, _ in properties]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{path}: property {name[:60]} of element {element[:60]} is there twice")
    return np.dtype(properties)
