"""The container .ply: its text header, and its elements as structured arrays.

Memory grows with the size of the file, whatever its header promises.
"""

from __future__ import annotations

import io
import itertools
import mmap
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.file_kinds import refuse_stand_in

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
_END = re.compile(rb"[\r\n]end_header[ \t]*(\r?\n|\r)")  # a line of its own: comments may contain the word
SMALL_BYTES = 1 << 16  # largest kept element beside the vertices
_MOST_STEPS = 1 << 20  # numbers and lists that are walked one by one: a second's work
_MOST_BYTES_AFTER = 16  # blank bytes after the data, as editors and shells append them
_LINES_AT_ONCE = 1 << 14  # parsed at a time
_WHOLE = ("vertex", "chunk", "sh")  # elements of Gaussians, compressed or not, are kept at any size
_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I"}


@dataclass(frozen=True)
class Property:
    """One column of an element.

    Attributes:
        name: as in the header.
        kind: NumPy's code of its numbers, such as "f4".
        length_kind: for a list, the code of its length; else None.
    """

    name: str
    kind: str
    length_kind: str | None = None


@dataclass
class Element:
    """One element of the header; has_lists: any of its properties is a list."""

    name: str
    count: int
    properties: list[Property]
    has_lists: bool = False

    def record(self, order: str) -> np.dtype:
        """Return the packed dtype of a row without lists; order: "<" or ">"."""
        return np.dtype([(column.name, order + column.kind) for column in self.properties])


@dataclass
class Header:
    """The header of a .ply file.

    Attributes:
        order: of bytes, "<" or ">"; "" for numbers as text.
        elements: in file order.
        comments: text of comment and obj_info lines.
        size_bytes: length of the header.
    """

    order: str
    elements: list[Element]
    comments: tuple[str, ...]
    size_bytes: int


def read_header(path: Path, start: bytes) -> Header:
    """Parse the first bytes of a .ply; raise InputError for another kind of file, or a malformed header."""
    start = start[:HEADER_LIMIT_BYTES]
    if start[:4] not in (b"ply\n", b"ply\r"):
        refuse_stand_in(path)
        raise InputError(f"{path} is not a .ply file: it does not begin with 'ply'")
    end = _END.search(start)
    if end is None:
        raise InputError(f"{path}: no end_header in the first {HEADER_LIMIT_BYTES} bytes; the file is cut or damaged")
    size_bytes = end.end()
    if b"\n" not in start[: end.start() + 1]:  # lines end in \r alone; a \n after the last is data
        size_bytes = end.start(1) + 1
    # splitlines would also split at other characters of Unicode
    lines = re.split(r"\r\n|\r|\n", start[: end.start()].decode("utf-8", "replace"))[1:]
    return _parse_lines(path, lines, size_bytes)


def _parse_lines(path: Path, lines: list[str], size_bytes: int) -> Header:
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
            case ["property", *words] if elements and (column := _parse_property(words)) is not None:
                elements[-1].properties.append(column)
                elements[-1].has_lists |= column.length_kind is not None
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


def _parse_property(words: list[str]) -> Property | None:
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


def read_elements(path: Path, header: Header) -> dict[str, np.ndarray]:
    """Read the elements of Gaussians, and others without lists of at most SMALL_BYTES.

    Returns:
        Structured arrays by name; the first of several elements of one name.

    Raises:
        InputError: the file is cut, or longer than the header promises.
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        return (_read_binary if header.order else _read_text)(path, file, header)


def _read_binary(path: Path, file: BinaryIO, header: Header) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    at, size = header.size_bytes, path.stat().st_size
    for element in header.elements:
        if element.has_lists:
            end = _end_of_lists(file, element, header.order, at, size)
            if end is None and "vertex" in found:
                return found  # nothing after long lists is needed
            if end is None:
                raise InputError(
                    f"{path}: the long element {element.name[:60]} with lists comes before the vertices; "
                    "export the file with the vertices first"
                )
        else:
            record = element.record(header.order)
            end = at + element.count * record.itemsize
        if end > size:
            raise _cut_error(path, element, f"the file has {size} bytes")
        if not element.has_lists and _is_kept(element, end - at) and element.name not in found:
            found[element.name] = _read_rows(path, file, element, record, at)
        at = end
    file.seek(at)
    if file.read(_MOST_BYTES_AFTER).strip() or size - at > _MOST_BYTES_AFTER:
        raise InputError(f"{path}: {size - at} bytes are left after what the header promises; its header is wrong")
    return found


def _read_text(path: Path, file: BinaryIO, header: Header) -> dict[str, np.ndarray]:
    """Read elements whose numbers are text, a line for each row."""
    file.seek(header.size_bytes)
    with io.TextIOWrapper(file, "latin-1") as text:
        return _read_lines(path, header, (line for line in text if not line.isspace()))


def _read_lines(path: Path, header: Header, lines: Iterator[str]) -> dict[str, np.ndarray]:
    """Read elements from the lines after the header that are not empty."""
    size = path.stat().st_size - header.size_bytes
    found: dict[str, np.ndarray] = {}
    for element in header.elements:
        if element.count * 2 * len(element.properties) > size + 1:  # a digit and a space each
            raise _cut_error(path, element, f"{size} bytes of text are left after it")
        if not element.properties:
            continue
        record = None if element.has_lists else _text_record(element)
        if record is not None and element.name not in found and _is_kept(element, element.count * record.itemsize):
            found[element.name] = _read_table(path, element, record, lines)
        elif (given := sum(1 for _ in itertools.islice(lines, element.count))) < element.count:
            raise _cut_error(path, element, f"the file has {given}")
    if next(lines, None) is not None:
        raise InputError(f"{path}: lines are left after what the header promises; its header is wrong")
    return found


def _text_record(element: Element) -> np.dtype:
    """Return the dtype of the rows; all floats are double, since the text may have more digits than float."""
    return np.dtype([(column.name, "f8" if column.kind[0] == "f" else column.kind) for column in element.properties])


def _read_table(path: Path, element: Element, record: np.dtype, lines: Iterator[str]) -> np.ndarray:
    table = np.empty(element.count, record)
    for start in range(0, element.count, _LINES_AT_ONCE):
        wanted = min(_LINES_AT_ONCE, element.count - start)
        rows = list(itertools.islice(lines, wanted))
        if len(rows) < wanted:
            raise _cut_error(path, element, f"the file has {start + len(rows)}")
        try:
            table[start : start + wanted] = np.loadtxt(rows, record, comments=None, ndmin=1)
        except (ValueError, OverflowError) as error:
            raise InputError(
                f"{path}: cannot read the rows of '{element.name[:60]}' from row {start} on, expected "
                f"{len(element.properties)} numbers in each: {' '.join(str(error).split())[:200]}"
            ) from None
    return table


def _cut_error(path: Path, element: Element, found: str) -> InputError:
    return InputError(
        f"{path}: the header promises {element.count} rows of '{element.name[:60]}', but {found}; it is "
        "cut or its header is wrong"
    )


def _is_kept(element: Element, size_bytes: int) -> bool:
    return element.name in _WHOLE or 0 < size_bytes <= SMALL_BYTES


def _read_rows(path: Path, file: BinaryIO, element: Element, record: np.dtype, at: int) -> np.ndarray:
    file.seek(at)
    rows = np.fromfile(file, record, element.count)
    if len(rows) < element.count:
        raise InputError(f"{path} was changed while it was read; try again")
    return rows if record.isnative else rows.byteswap(inplace=True).view(record.newbyteorder())


def _end_of_lists(file: BinaryIO, element: Element, order: str, at: int, size: int) -> int | None:
    """Return the end of rows with lists, beyond `size` if the file is cut; None if finding it takes too long."""
    if element.count == 0:
        return at
    if element.count * len(element.properties) > _MOST_STEPS:
        return None
    columns = [
        (np.dtype(column.kind).itemsize, struct.Struct(order + _CODES[kind]) if (kind := column.length_kind) else None)
        for column in element.properties
    ]
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for _ in range(element.count):
            for item_bytes, length in columns:
                if length is None:
                    at += item_bytes
                elif at + length.size > size:
                    return size + 1
                else:
                    count = length.unpack_from(data, at)[0]
                    if count < 0:
                        return size + 1
                    at += length.size + count * item_bytes
    return at
