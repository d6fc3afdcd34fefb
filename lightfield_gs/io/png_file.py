"""Writes PNG files of panels' images, three times as fast as zlib does: deflate by ISA-L.

Source: Portable Network Graphics (PNG) Specification (Third Edition), W3C, 2025, sections 5.3, 9.2 and 11.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from lightfield_gs.io.png_chunks import SIGNATURE

_COLOUR_TYPES = {1: 0, 3: 2, 4: 6}  # by channels: grey, RGB, RGB with alpha
_UP = 2  # the filter that takes off the pixel above
_LEVEL = 1  # of ISA-L's four, 0..3: files as large as zlib's runs make them; more costs time and saves nothing
# About what is compressed at once: a few calls an image, since threads of Python take turns between calls
_BLOCK_BYTES = 1 << 24
# What readers are to take the numbers for, sRGB, and for those that do not know of it the same in numbers
_SRGB = {
    b"sRGB": b"\0",
    b"gAMA": struct.pack(">I", 45455),
    b"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000),
}


@dataclass(frozen=True)
class CompressedImage:
    """An image of 8 bits that is compressed already, such as by a GPU (io/png_cuda.py).

    shape: H, W, C with C = 1, 3 or 4. stream: the zlib stream of the filtered rows, in parts. is_plain: whether the
    image has one colour.
    """

    shape: tuple[int, ...]
    stream: Sequence[bytes | memoryview]
    is_plain: bool
    dtype = np.dtype(np.uint8)
    ndim = 3


def write_png(path: Path, image: np.ndarray | CompressedImage, texts: Mapping[str, str]) -> None:
    """Writes [H, W, C], uint8 or uint16, C = 1, 3 or 4, alpha straight, as sRGB. texts: by their keywords, Latin-1.

    Nothing is checked, and the file grows as it is written. Raises OSError.
    """
    height, width, channels = image.shape
    with path.open("wb") as file:
        file.write(SIGNATURE)
        header = (width, height, 8 * image.dtype.itemsize, _COLOUR_TYPES[channels], 0, 0, 0)
        _write(file, b"IHDR", struct.pack(">IIBBBBB", *header))
        for kind, data in _SRGB.items():
            _write(file, kind, data)
        for keyword, text in texts.items():
            _write(file, b"tEXt", f"{keyword}\0{text}".encode("latin-1", "replace"))
        for part in image.stream if isinstance(image, CompressedImage) else _compressed(image):
            _write(file, b"IDAT", part)
        _write(file, b"IEND", b"")


def _compressed(pixels: np.ndarray) -> Iterator[bytes]:
    """The zlib stream of the filtered rows, in parts."""
    from isal import isal_zlib

    height = len(pixels)
    rows = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder(">")).reshape(height, -1).view(np.uint8)
    count = max(1, _BLOCK_BYTES // rows.shape[1])
    filtered = np.empty((min(count, height), 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = _UP
    stream = isal_zlib.compressobj(_LEVEL)
    for first in range(0, height, count):
        block = rows[first : first + count]
        out = filtered[: len(block), 1:]
        np.subtract(block[1:], block[:-1], out=out[1:])
        out[0] = block[0] - (rows[first - 1] if first else 0)
        if part := stream.compress(filtered[: len(block)]):
            yield part
    yield stream.flush()


def _write(file: BinaryIO, kind: bytes, data: bytes | memoryview) -> None:
    """A chunk: length, type, data and checksum."""
    from isal import isal_zlib

    file.write(struct.pack(">I", len(data)) + kind)
    file.write(data)
    file.write(struct.pack(">I", isal_zlib.crc32(data, isal_zlib.crc32(kind))))
