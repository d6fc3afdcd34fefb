"""The .ksplat of GaussianSplats3D (mkkellogg), versions 0.x, in the axes of the original .ply.

A header of 4096 bytes and one of 1024 bytes for each section precede the sections. A section has the fill of its partly
filled buckets, the buckets' centres, and its Gaussians. A Gaussian has centre, three standard deviations, quaternion
wxyz, and four bytes of colour and opacity. Harmonics follow channel by channel for each degree (0..2; others write 3).
Compression level 0 has floats. Levels 1 and 2 have half floats, and centres as 16-bit offsets from the centre of their
bucket. Level 2 has harmonics as bytes. Layout: SplatBuffer.js.
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.file_kinds import refuse_stand_in
from lightfield_gs.io.scenes.scene_arrays import (
    SceneArrays,
    check_not_empty,
    checked_fields,
    concatenate_fields,
    rgb_to_sh,
)

_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
_HEADER = struct.Struct("<BB2xIIIIH2x3fff")
_SECTION = struct.Struct("<IIIIfH2xIIIIH")
_CENTRE_BYTES = 12  # of a bucket
_KINDS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))  # by level: centre, shape, harmonics
_RANGES = (1, 32767, 32767)  # by level: of a centre's offset, where a section does not say
_RESTS = (0, 9, 24, 45)  # numbers of coefficients above degree 0, by degree
_SPANS = ((0, 3), (3, 8), (8, 15))  # coefficients of degrees 1, 2 and 3 among those above degree 0
_LIMIT = 1.5  # of harmonics as bytes, where the file does not say


@dataclass
class _Section:
    """A section of the file.

    Attributes:
        offset: of its bytes in the file.
        count: number of Gaussians.
        bucket_size: Gaussians in a full bucket.
        buckets: number of buckets.
        bucket_bytes: size of a bucket's centre.
        full, partial: numbers of full and of partly filled buckets.
        step: of the offsets of centres, scene units.
        half_range: offset of the bucket's centre.
        degree: of harmonics.
    """

    offset: int
    count: int
    bucket_size: int
    buckets: int
    bucket_bytes: int
    full: int
    partial: int
    step: float
    half_range: int
    degree: int

    def record(self, level: int) -> np.dtype:
        centre, shape, rest = _KINDS[level]
        fields = [("means", centre, 3), ("scales", shape, 3), ("rotation", shape, 4), ("rgba", "u1", 4)]
        return np.dtype([*fields, ("rest", rest, _RESTS[self.degree])])

    @property
    def buckets_bytes(self) -> int:
        return 4 * self.partial + self.bucket_bytes * self.buckets


def read(path: Path, skip_invalid: bool) -> SceneArrays:
    """Read a .ksplat; see files.read_arrays."""
    if (size := path.stat().st_size) < _HEADER_BYTES:
        refuse_stand_in(path)
        raise InputError(f"{path}: a .ksplat has a header of {_HEADER_BYTES} bytes, and it has {size}; it is cut")
    with open(path, "rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)  # reads no more than is used
    major, minor, sections, _, _, _, level, *_, low, high = _HEADER.unpack_from(data)
    if major != 0 or level >= len(_KINDS):
        raise InputError(
            f"{path}: expected a .ksplat of version 0.x and compression level 0..2, got {major}.{minor} and {level}; "
            "export it again"
        )
    if low == high == 0:
        low, high = -_LIMIT, _LIMIT
    found = _sections(path, data, sections, level)
    check_not_empty(path, sum(section.count for section in found))
    parts = [_gaussians(path, data, section, level, (low, high)) for section in found if section.count]
    fields, notes = checked_fields(path, concatenate_fields(parts), skip_invalid)
    return SceneArrays(fields, notes=notes, kind=f".ksplat version {major}.{minor}, compression level {level}")


def _sections(path: Path, data: mmap.mmap, sections: int, level: int) -> list[_Section]:
    """Read the headers of all sections at their full sizes, as the viewer does; raise InputError for a cut file.

    The counts of loaded Gaussians may be zero in a whole file.
    """
    at = _HEADER_BYTES + sections * _SECTION_BYTES
    if at > len(data):
        raise InputError(
            f"{path}: {sections} sections are promised, and the file has {len(data)} bytes; it is cut or its header is "
            "wrong"
        )
    found = []
    for index in range(sections):
        _, count, size, buckets, block, stored, half, _, full, partial, degree = _SECTION.unpack_from(
            data, _HEADER_BYTES + index * _SECTION_BYTES
        )
        if degree >= len(_RESTS):
            raise InputError(f"{path}: expected harmonics of degree 0..3 in section {index}, got {degree}")
        if level > 0 and stored != _CENTRE_BYTES:
            raise InputError(f"{path}: expected buckets of {_CENTRE_BYTES} bytes in section {index}, got {stored}")
        half = half or _RANGES[level]
        section = _Section(at, count, size, buckets, stored, full, partial, block / 2 / half, half, degree)
        at += section.buckets_bytes + count * section.record(level).itemsize
        if at > len(data):
            raise InputError(
                f"{path}: section {index} of {count} Gaussians ends at byte {at}, and the file has {len(data)}; it is "
                "cut or its header is wrong"
            )
        found.append(section)
    return found


def _gaussians(
    path: Path, data: mmap.mmap, section: _Section, level: int, limits: tuple[float, float]
) -> dict[str, np.ndarray]:
    """Return the fields of a section's Gaussians, float64."""
    rows = np.frombuffer(data, section.record(level), section.count, section.offset + section.buckets_bytes)
    with np.errstate(over="ignore", invalid="ignore"):
        means = rows["means"].astype(np.float64)
        if level > 0:
            means = (means - section.half_range) * section.step + _bucket_centres(path, data, section)
        rest = rows["rest"].astype(np.float64)
        if level == 2:
            rest = limits[0] + (limits[1] - limits[0]) * rest / 255
        colours = rows["rgba"] / 255
        first = rgb_to_sh(colours[:, None, :3])
        return {
            "means": means,
            "quaternions": rows["rotation"].astype(np.float64),
            "scales": rows["scales"].astype(np.float64),
            "opacities": colours[:, 3],
            "sh": np.concatenate([first, *_degrees(rest, section.degree)], 1),
        }


def _degrees(rest: np.ndarray, degree: int) -> list[np.ndarray]:
    """Split the numbers [N, 3 (K - 1)] into coefficients [N, 2 degree + 1, 3] of each degree."""
    return [rest[:, 3 * a : 3 * b].reshape(len(rest), 3, b - a).transpose(0, 2, 1) for a, b in _SPANS[:degree]]


def _bucket_centres(path: Path, data: mmap.mmap, section: _Section) -> np.ndarray:
    """Return the centre of each Gaussian's bucket, [N, 3]; full buckets precede partly filled ones."""
    fills = np.frombuffer(data, "<u4", section.partial, section.offset).astype(np.int64)
    centres = np.frombuffer(data, "<f4", 3 * section.buckets, section.offset + 4 * section.partial).reshape(-1, 3)
    rows = np.arange(section.count)
    whole = section.full * section.bucket_size
    bucket = rows // max(1, section.bucket_size)
    bucket[whole:] = section.full + np.searchsorted(np.cumsum(fills), rows[whole:] - whole, side="right")
    if int(bucket.max()) >= len(centres):
        raise InputError(
            f"{path}: {section.buckets} buckets of {section.bucket_size} are too few for {section.count} Gaussians; "
            "its header is wrong"
        )
    return centres.astype(np.float64)[bucket]
