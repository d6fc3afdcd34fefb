"""Niantic's .spz, versions 1 to 4: 16 to 20 bytes a Gaussian and its harmonics, compressed.

Centres are fixed-point numbers of 24 bits (version 1: half floats). Logarithms of scales (b / 16 - 10), opacities
(b / 255), colours of degree 0 ((b / 255 - 0.5) / 0.15) and further harmonics (b / 128 - 1) are bytes. Rotations are
x y z of a quaternion as bytes, from version 3 on its three smallest components of 10 bits. The axes are right, up, back
(RUB): they are turned about x to the axes of a .ply: right, down, forward (README of spz, "Coordinate System").

Versions 1 to 3 are one gzip stream of a header of 16 bytes and the attributes one after the other. Version 4 has a
header of 32 bytes, extensions, a table of sizes and a zstd stream for each attribute. Layout: Niantic's spz (README,
load-spz.cc). The header is read first, and the file's size bounds the unpacked data.
"""

from __future__ import annotations

import math
import mmap
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.file_kinds import refuse_stand_in
from lightfield_gs.io.scenes import comments
from lightfield_gs.io.scenes.plausibility import check_unpacked_size, gunzip, typical_size, unzstd
from lightfield_gs.io.scenes.scene_arrays import (
    HIGH_DEGREE_NOTE,
    Y_UP_SIGNS,
    Y_UP_TURN,
    Fields,
    Origin,
    SceneArrays,
    check_not_empty,
    checked_fields,
    complete_quaternions,
    header_losses,
)

Data = bytes | mmap.mmap
MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
_COEFFICIENTS = (1, 4, 9, 16, 25)  # of degree 0..4
_ANTIALIASED, _EXTENDED = 1, 2  # flags
_ZSTD_VERSION = 4
_MOST_FRACTION_BITS = 23  # of 24, the rest being a sign
_HEADER, _ZSTD_HEADER = struct.Struct("<4sIIBBBB"), struct.Struct("<4sIIBBBBI12x")
_SIZES = struct.Struct("<QQ")
_START_BYTES, _MORE_BYTES = 1 << 16, 1 << 20
_RECORD = struct.Struct("<II")  # type and length of an extension
_SH_QUANTIZATION = 0xADBE0001  # Adobe's: harmonics within limits other than -1..1
_COLOUR_SCALE = 0.15
_LEAST_FRACTION_BITS = 12  # of centres, as other programs write
_CENTRE_STEP = 1 / 8  # of the typical Gaussian's size: coarser steps of centres show
_LARGEST_CENTRE = (1 << 23) - 1  # as stored
_ROTATION_STEP = math.sqrt(0.5) / 511
_WRITTEN_VERSION = 3
_BUCKETS = (8, 16)  # steps of harmonics of degree 1, and above (5 and 4 bits), for better compression


@dataclass
class _Streams:
    """The contents of the container.

    Attributes:
        version: 1..4.
        count: number of Gaussians.
        degree: of harmonics, 0..4.
        fraction_bits: of centres.
        flags: as stored.
        attributes: bytes of centres, opacities, colours, scales, rotations and harmonics, each of the right length.
    """

    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int
    attributes: list[bytes]


def _read_streams(path: Path, data: Data) -> _Streams:
    """Read the container; raise InputError for other data, cut data, and data with less than they state."""
    if data[:4] == MAGIC:
        return _read_zstd_streams(path, data)
    if data[:2] != GZIP_MAGIC:
        refuse_stand_in(path)
        raise InputError(f"{path} is no .spz: it begins neither as gzip data nor with NGSP")
    start = gunzip(path, data[:_START_BYTES], _HEADER.size)
    if len(start) < _HEADER.size or start[:4] != MAGIC:
        raise InputError(
            f"{path} is no .spz: its gzip data do not begin with a header NGSP; it is cut or something else"
        )
    _, version, count, degree, bits, flags, _ = _HEADER.unpack(start)
    if not 1 <= version < _ZSTD_VERSION:
        raise InputError(f"{path}: expected version 1, 2 or 3 in gzip data, got {version}; export it as SPZ version 3")
    streams = _check_header(path, _Streams(version, count, degree, bits, flags, []))
    sizes = _attribute_bytes(streams)
    check_unpacked_size(path, sum(sizes), len(data))
    # No more than these bytes can take when compressed, and extensions
    packed = data[: _max_packed_bytes(sum(sizes))]
    body = gunzip(path, packed, _HEADER.size + sum(sizes) + _RECORD.size)[_HEADER.size :]
    _refuse_sh_quantization(path, body[: _RECORD.size] if flags & _EXTENDED else b"")
    _refuse_sh_quantization(path, body[sum(sizes) :] if flags & _EXTENDED else b"")
    if len(body) < sum(sizes) or len(body) > sum(sizes) and not flags & _EXTENDED:
        raise _size_error(path, streams, sum(sizes), len(body))
    at = 0
    for size in sizes:
        streams.attributes.append(body[at : at + size])
        at += size
    return streams


def _read_zstd_streams(path: Path, data: Data) -> _Streams:
    """Read the container of version 4."""
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
    streams = _check_header(path, _Streams(version, count, degree, bits, flags, []))
    sizes = _attribute_bytes(streams)
    wanted = [size for size in sizes if size]
    end = at + _SIZES.size * tables
    if tables != len(wanted) or at < _ZSTD_HEADER.size or end > len(data):
        raise InputError(
            f"{path}: expected a table of {len(wanted)} streams within the file, got {tables} at byte {at}; it is cut "
            "or its header is wrong"
        )
    if flags & _EXTENDED:
        _check_extensions(path, data[_ZSTD_HEADER.size : at])
    check_unpacked_size(path, sum(sizes), len(data))
    for index, size in enumerate(wanted):
        packed, unpacked = _SIZES.unpack_from(data, at + _SIZES.size * index)
        if unpacked != size or packed > _max_packed_bytes(size) or end + packed > len(data):
            raise _size_error(path, streams, size, unpacked)
        streams.attributes.append(unzstd(path, data[end : end + packed], size))
        end += packed
    streams.attributes += [b""] * (len(sizes) - len(wanted))
    return streams


def _max_packed_bytes(size_bytes: int) -> int:
    """Return the largest compressed size of this number of bytes, with a header and small extensions."""
    return size_bytes + size_bytes // 64 + _MORE_BYTES


def _check_header(path: Path, streams: _Streams) -> _Streams:
    """Return the streams, or raise InputError for impossible numbers."""
    check_not_empty(path, streams.count)
    if streams.degree >= len(_COEFFICIENTS):
        raise InputError(f"{path}: expected harmonics of degree 0..4, got {streams.degree}; its header is wrong")
    if streams.fraction_bits > _MOST_FRACTION_BITS:
        raise InputError(
            f"{path}: expected 0..{_MOST_FRACTION_BITS} fractional bits, got {streams.fraction_bits}; its header is "
            "wrong"
        )
    return streams


def _attribute_bytes(streams: _Streams) -> list[int]:
    """Return the size of each attribute in bytes."""
    each = [
        6 if streams.version == 1 else 9,
        1,
        3,
        3,
        4 if streams.version >= 3 else 3,
        3 * (_COEFFICIENTS[streams.degree] - 1),
    ]
    return [streams.count * size for size in each]


def _check_extensions(path: Path, records: bytes) -> None:
    """Raise InputError for an extension that changes the meaning of the attributes."""
    at = 0
    while at + _RECORD.size <= len(records):
        _refuse_sh_quantization(path, records[at:])
        at += _RECORD.size + _RECORD.unpack_from(records, at)[1]


def _refuse_sh_quantization(path: Path, record: bytes) -> None:
    """Raise InputError for the extension that stores harmonics within other limits."""
    if record[:4] == _SH_QUANTIZATION.to_bytes(4, "little"):
        raise InputError(
            f"{path} has the extension SPZ_ADOBE_sh_quantization, which is not read; export it without or as .ply"
        )


def _size_error(path: Path, streams: _Streams, expected: int, got: int) -> InputError:
    return InputError(
        f"{path}: {streams.count} Gaussians of degree {streams.degree} (SPZ version {streams.version}) take {expected} "
        f"bytes, and there are {got}; it is cut or its header is wrong"
    )


def read(path: Path, skip_invalid: bool) -> SceneArrays:
    """Read an .spz; see files.read_arrays."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return decode(path, data, skip_invalid)


@np.errstate(invalid="ignore")
def decode(path: Path, data: Data, skip_invalid: bool) -> SceneArrays:
    """Decode the bytes of an .spz.

    Args:
        path: file that holds the bytes, for messages.
        data: the bytes.
        skip_invalid: leave out Gaussians with invalid values.

    Raises:
        InputError: as read_scene.
    """
    streams = _read_streams(path, data)
    positions, opacities, colours, scales, rotations, rest = (
        np.frombuffer(data, np.uint8).reshape(streams.count, -1) for data in streams.attributes[:6]
    )
    shape = (streams.count, _COEFFICIENTS[streams.degree] - 1, 3)
    sh = np.concatenate(
        [
            ((colours / 255 - 0.5) / _COLOUR_SCALE)[:, None],
            rest.reshape(shape)[:, : len(Y_UP_SIGNS) - 1].astype(np.float32) / 128 - 1,
        ],
        1,
    )
    fields = {
        "means": _decode_centres(streams, positions) * Y_UP_TURN,
        "quaternions": _decode_rotations(streams, rotations) * np.append(1.0, Y_UP_TURN),
        "scales": np.exp(scales / 16 - 10),
        "opacities": opacities[:, 0] / 255,
        "sh": sh * Y_UP_SIGNS[: sh.shape[1]],
    }
    fields, notes = checked_fields(path, fields, skip_invalid)
    if streams.degree == len(_COEFFICIENTS) - 1:
        notes.append(HIGH_DEGREE_NOTE)
    lines = (comments.Y_DOWN, *([comments.ANTIALIASED] if streams.flags & _ANTIALIASED else []))
    kind = f"SPZ version {streams.version}, axes turned from right-up-back to right-down-forward"
    return SceneArrays(fields, comments=lines, notes=notes, kind=kind)


def _decode_centres(streams: _Streams, stored: np.ndarray) -> np.ndarray:
    if streams.version == 1:
        return stored.view("<f2").astype(np.float64)
    three = stored.reshape(-1, 3, 3).astype(np.int32)
    whole = three[..., 0] | three[..., 1] << 8 | three[..., 2] << 16
    return (whole - ((whole & 1 << 23) << 1)) / (1 << streams.fraction_bits)


def _decode_rotations(streams: _Streams, stored: np.ndarray) -> np.ndarray:
    """Decode quaternions [N, 4], wxyz."""
    if streams.version < 3:
        return complete_quaternions(stored / 127.5 - 1, np.zeros(streams.count, np.int64))
    words = np.ascontiguousarray(stored).view("<u4")[:, 0]
    parts = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], 1).astype(np.float64)
    three = np.where(parts >= 512, 512 - parts, parts) * _ROTATION_STEP
    return np.roll(complete_quaternions(three, words >> 30), 1, axis=1)  # stored as xyzw


def write(path: str | Path, fields: Fields, origin: Origin, lines: Sequence[str] = ()) -> list[str]:
    """Write float64 fields of N >= 1 valid Gaussians as version 3.

    Args:
        path: the file.
        fields: the five fields.
        origin: position of the means' zero.
        lines: comments; the format keeps only whether they declare training with anti-aliasing.

    Returns:
        Losses, one line each.
    """
    antialiased = comments.is_antialiased(lines) is True
    means, sh = fields["means"] * Y_UP_TURN, fields["sh"] * Y_UP_SIGNS[: fields["sh"].shape[1]]
    bits = _fraction_bits(path, means, fields["scales"])
    whole = np.round(means * (1 << bits)).astype(np.int32)
    logs = np.log(fields["scales"])
    degree = _COEFFICIENTS.index(sh.shape[1])
    body = [
        struct.pack("<4sIIBBBB", MAGIC, _WRITTEN_VERSION, len(means), degree, bits, _ANTIALIASED * antialiased, 0),
        np.stack([whole >> shift & 255 for shift in (0, 8, 16)], -1).astype(np.uint8).tobytes(),
        _encode_bytes(fields["opacities"] * 255),
        _encode_bytes((sh[:, 0] * _COLOUR_SCALE + 0.5) * 255),
        _encode_bytes((logs + 10) * 16),
        _encode_rotations(fields["quaternions"] * np.append(1.0, Y_UP_TURN)),
        _encode_harmonics(sh[:, 1:]),
    ]
    packer = zlib.compressobj(6, zlib.DEFLATED, 31)  # no time or name in its header: the same bytes each time
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        for part in body:
            file.write(packer.compress(part))
        file.write(packer.flush())
    return [*_losses(logs, sh), *header_losses(path, origin, lines)]


def _fraction_bits(path: str | Path, means: np.ndarray, scales: np.ndarray) -> int:
    """Return the fraction bits that small Gaussians need and the farthest centre leaves; raise InputError for none."""
    farthest, size = float(np.abs(means).max()), typical_size(scales)
    available = 23 if farthest == 0 else min(23, math.floor(math.log2(_LARGEST_CENTRE / farthest)))
    if available < 0:
        raise InputError(
            f"cannot write {path}: an .spz holds coordinates up to {_LARGEST_CENTRE}, and there are some of "
            f"{farthest:.3g}; write a .ply"
        )
    wanted = _LEAST_FRACTION_BITS if math.isinf(size) else math.ceil(-math.log2(size * _CENTRE_STEP))
    return min(available, max(_LEAST_FRACTION_BITS, wanted))


def _encode_bytes(values: np.ndarray) -> bytes:
    return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()


def _encode_rotations(quaternions: np.ndarray) -> bytes:
    xyzw = np.roll(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True), -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    xyzw = np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -xyzw, xyzw)
    three = xyzw[np.arange(4) != largest[:, None]].reshape(-1, 3)
    parts = (
        np.minimum(np.round(np.abs(three) / _ROTATION_STEP), 511).astype(np.uint32) | (three < 0).astype(np.uint32) << 9
    )
    words = largest.astype(np.uint32) << 30 | parts[:, 0] << 20 | parts[:, 1] << 10 | parts[:, 2]
    return words.astype("<u4").tobytes()


def _encode_harmonics(rest: np.ndarray) -> bytes:
    steps = np.where(np.arange(rest.shape[1]) < 3, *_BUCKETS)[:, None]
    return _encode_bytes(np.floor((np.round(rest * 128) + 128 + steps // 2) / steps) * steps)


def _losses(logs: np.ndarray, sh: np.ndarray) -> list[str]:
    """Describe values outside the ranges of the format, one line each."""
    lost = []
    if far := int(((logs < -10 - 1 / 32) | (logs > 255 / 16 - 10 + 1 / 32)).any(1).sum()):
        lost.append(f"{far} Gaussians have scales outside of 4.5e-5..380, which an .spz cuts to that")
    if far := int((np.abs(sh[:, 1:]) > 1.01).any((1, 2)).sum()):
        lost.append(f"{far} Gaussians have harmonics outside of -1..1, which an .spz cuts to that")
    return lost
