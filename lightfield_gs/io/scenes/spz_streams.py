"""The container of an .spz: its header, and the bytes of each attribute, whatever they are compressed by.

Versions 1 to 3 are one gzip stream of a header of 16 bytes and the attributes one after the other. Version 4 has a
header of 32 bytes, extensions, a table of sizes and a zstd stream for each attribute. Layout: Niantic's spz (README,
load-spz.cc). A file's size bounds what is unpacked, and a header is read before anything else.
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.not_what_it_says import refuse_stand_in
from lightfield_gs.io.scenes.bounded import check_promise, gunzip, unzstd
from lightfield_gs.io.scenes.stored_scene import expect_some

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
COEFFICIENTS = (1, 4, 9, 16, 25)  # of degree 0..4
ANTIALIASED, _EXTENDED = 1, 2  # flags
_ZSTD_VERSION = 4
_MOST_FRACTION_BITS = 23  # of 24, the rest being a sign
_HEADER, _ZSTD_HEADER = struct.Struct("<4sIIBBBB"), struct.Struct("<4sIIBBBBI12x")
_SIZES = struct.Struct("<QQ")
_START_BYTES, _MORE_BYTES = 1 << 16, 1 << 20
_RECORD = struct.Struct("<II")  # type and length of an extension
_SH_QUANTIZATION = 0xADBE0001  # Adobe's: harmonics within other limits than -1..1


@dataclass
class Streams:
    """version: 1..4. count: of Gaussians. degree: 0..4. fraction_bits: of centres. flags: as stored. attributes: the
    bytes of centres, opacities, colours, scales, rotations and harmonics, in this order, each of the right length.
    """

    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int
    attributes: list[bytes]


def read_streams(path: Path) -> Streams:
    """Raises InputError where the file is no .spz, cut, or promises what it does not hold."""
    with open(path, "rb") as file:
        packed = file.read(_START_BYTES)
    if packed[:4] == MAGIC:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            return _zstd_streams(path, data)
    if packed[:2] != GZIP_MAGIC:
        refuse_stand_in(path)
        raise InputError(f"{path} is no .spz: it begins neither as gzip data nor with NGSP")
    start = gunzip(path, packed, _HEADER.size)
    if len(start) < _HEADER.size or start[:4] != MAGIC:
        raise InputError(
            f"{path} is no .spz: its gzip data do not begin with a header NGSP; it is cut or something else"
        )
    _, version, count, degree, bits, flags, _ = _HEADER.unpack(start)
    if not 1 <= version < _ZSTD_VERSION:
        raise InputError(f"{path}: expected version 1, 2 or 3 in gzip data, got {version}; export it as SPZ version 3")
    streams = _checked(path, Streams(version, count, degree, bits, flags, []))
    sizes = _sizes(streams)
    check_promise(path, sum(sizes), path.stat().st_size)
    with open(path, "rb") as file:  # no more than so many bytes can take when packed, and extensions
        packed = file.read(_most_packed(sum(sizes)))
    body = gunzip(path, packed, _HEADER.size + sum(sizes) + _RECORD.size)[_HEADER.size :]
    _refuse_other_harmonics(path, body[: _RECORD.size] if flags & _EXTENDED else b"")
    _refuse_other_harmonics(path, body[sum(sizes) :] if flags & _EXTENDED else b"")
    if len(body) < sum(sizes) or len(body) > sum(sizes) and not flags & _EXTENDED:
        raise _wrong_size(path, streams, sum(sizes), len(body))
    at = 0
    for size in sizes:
        streams.attributes.append(body[at : at + size])
        at += size
    return streams


def _zstd_streams(path: Path, data: mmap.mmap) -> Streams:
    """Those of version 4."""
    version = int.from_bytes(data[4:8], "little")
    if len(data) >= _HEADER.size and 1 <= version < _ZSTD_VERSION:
        raise InputError(
            f"{path} is an .spz of version {version} that is not compressed, and the format is gzip data up to version "
            "3; compress it (gzip), or export it again"
        )
    if len(data) < _ZSTD_HEADER.size:
        raise InputError(
            f"{path}: an .spz has a header of {_ZSTD_HEADER.size} bytes, and it has {len(data)}; it is cut"
        )
    _, version, count, degree, bits, flags, tables, at = _ZSTD_HEADER.unpack_from(data)
    if version != _ZSTD_VERSION:
        raise InputError(f"{path}: expected SPZ version 1..4, got {version}; export it as SPZ version 3 or .ply")
    streams = _checked(path, Streams(version, count, degree, bits, flags, []))
    sizes = _sizes(streams)
    wanted = [size for size in sizes if size]
    end = at + _SIZES.size * tables
    if tables != len(wanted) or at < _ZSTD_HEADER.size or end > len(data):
        raise InputError(
            f"{path}: expected a table of {len(wanted)} streams within the file, got {tables} at byte {at}; it is cut "
            "or its header is wrong"
        )
    if flags & _EXTENDED:
        _check_extensions(path, data[_ZSTD_HEADER.size : at])
    check_promise(path, sum(sizes), len(data))
    for index, size in enumerate(wanted):
        packed, unpacked = _SIZES.unpack_from(data, at + _SIZES.size * index)
        if unpacked != size or packed > _most_packed(size) or end + packed > len(data):
            raise _wrong_size(path, streams, size, unpacked)
        streams.attributes.append(unzstd(path, data[end : end + packed], size))
        end += packed
    streams.attributes += [b""] * (len(sizes) - len(wanted))
    return streams


def _most_packed(size_bytes: int) -> int:
    """The most bytes that so many can take when compressed, with a header and small extensions."""
    return size_bytes + size_bytes // 64 + _MORE_BYTES


def _checked(path: Path, streams: Streams) -> Streams:
    expect_some(path, streams.count)
    if streams.degree >= len(COEFFICIENTS):
        raise InputError(f"{path}: expected harmonics of degree 0..4, got {streams.degree}; its header is wrong")
    if streams.fraction_bits > _MOST_FRACTION_BITS:
        raise InputError(
            f"{path}: expected 0..{_MOST_FRACTION_BITS} fractional bits, got {streams.fraction_bits}; its header is "
            "wrong"
        )
    return streams


def _sizes(streams: Streams) -> list[int]:
    """Bytes of each attribute."""
    each = [
        6 if streams.version == 1 else 9,
        1,
        3,
        3,
        4 if streams.version >= 3 else 3,
        3 * (COEFFICIENTS[streams.degree] - 1),
    ]
    return [streams.count * size for size in each]


def _check_extensions(path: Path, records: bytes) -> None:
    """Raises InputError for an extension that changes what the attributes mean."""
    at = 0
    while at + _RECORD.size <= len(records):
        _refuse_other_harmonics(path, records[at:])
        at += _RECORD.size + _RECORD.unpack_from(records, at)[1]


def _refuse_other_harmonics(path: Path, record: bytes) -> None:
    if record[:4] == _SH_QUANTIZATION.to_bytes(4, "little"):
        raise InputError(
            f"{path} has the extension SPZ_ADOBE_sh_quantization, which is not read; export it without or as .ply"
        )


def _wrong_size(path: Path, streams: Streams, expected: int, got: int) -> InputError:
    return InputError(
        f"{path}: {streams.count} Gaussians of degree {streams.degree} (SPZ version {streams.version}) take {expected} "
        f"bytes, and there are {got}; it is cut or its header is wrong"
    )
