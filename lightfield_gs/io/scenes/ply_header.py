"""The text header of a .ply file, read with distrust."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.not_what_it_says import refuse_stand_in

HEADER_LIMIT_BYTES = 1 << 16
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_END = re.compile(rb"[\r\n]end_header[ \t]*(\r?\n|\r)")  # a line of its own: comments may hold the word


@dataclass(frozen=True)
class Property:
    """One column of an element. kind: NumPy's code of its numbers, as "f4"; length_kind: of a list, the code of the
    number that says how long it is, else None."""

    name: str
    kind: str
    length_kind: str | None = None


@dataclass
class Element:
    """One element of the header."""

    name: str
    count: int
    properties: list[Property]

    @property
    def has_lists(self) -> bool:
        return any(column.length_kind is not None for column in self.properties)

    def record(self, order: str) -> np.dtype:
        """The packed dtype of a row without lists; order: "<" or ">"."""
        return np.dtype([(column.name, order + column.kind) for column in self.properties])


@dataclass
class Header:
    """What a header says.

    order: of the bytes, "<" or ">", or "" where numbers are text. elements: in file order. comments: the text of
    comment and obj_info lines. size_bytes: length of the header.
    """

    order: str
    elements: list[Element]
    comments: tuple[str, ...]
    size_bytes: int


def read_header(path: Path, start: bytes) -> Header:
    """Parses the first bytes of a .ply. Raises InputError when it is another kind of file, or a malformed header."""
    start = start[:HEADER_LIMIT_BYTES]
    if start[:4] not in (b"ply\n", b"ply\r"):
        refuse_stand_in(path)
        raise InputError(f"{path} is not a .ply file: it does not begin with 'ply'")
    end = _END.search(start)
    if end is None:
        raise InputError(f"{path}: no end_header in the first {HEADER_LIMIT_BYTES} bytes; the file is cut or damaged")
    size_bytes = end.end()
    if b"\n" not in start[: end.start() + 1]:  # lines end with \r alone, and a \n after the last is data
        size_bytes = end.start(1) + 1
    # splitlines would also take other characters of Unicode for ends of lines
    lines = re.split(r"\r\n|\r|\n", start[: end.start()].decode("utf-8", "replace"))[1:]
    return _parsed(path, lines, size_bytes)


def _parsed(path: Path, lines: list[str], size_bytes: int) -> Header:
    elements: list[Element] = []
    comments: list[str] = []
    file_format = None
    for line in lines:
        match line.split():
            case []:
                continue
            case ["comment" | "obj_info" as word, *_]:
                comments.append(line.strip()[len(word) :].strip())
            case ["format", kind, _]:
                file_format = kind
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 32:
                elements.append(Element(name, int(count), []))
            case ["property", *words] if elements and (column := _column(words)) is not None:
                elements[-1].properties.append(column)
            case _:
                raise InputError(f"{path}: cannot read the header line {line[:80]!r}")
    if file_format not in _ORDERS:
        raise InputError(
            f"{path}: expected format {', '.join(_ORDERS)}, got {(file_format or 'none')[:60]}; "
            "export it as a binary little-endian .ply"
        )
    for element in elements:
        _check_names(path, element)
    return Header(_ORDERS[file_format], elements, tuple(comments), size_bytes)


def _column(words: list[str]) -> Property | None:
    match words:
        case ["list", length, kind, name] if kind in _TYPES and _TYPES.get(length, "f")[0] != "f":
            return Property(name, _TYPES[kind], _TYPES[length])
        case [kind, name] if kind in _TYPES:
            return Property(name, _TYPES[kind])
    return None


def _check_names(path: Path, element: Element) -> None:
    seen: set[str] = set()
    for column in element.properties:
        if column.name in seen:
            raise InputError(f"{path}: property {column.name[:60]} of element {element.name[:60]} is there twice")
        seen.add(column.name)
