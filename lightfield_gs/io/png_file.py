"""Writes PNG files of panels' images, three times as fast as zlib does: deflate by ISA-L.

Source: Portable Network Graphics (PNG) Specification (Third Edition), W3C, 2025, sections 5.3, 9.2 and 11.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from lightfield_gs.io.png_chunks import SIGNATURE

if TYPE_CHECKING:
    from torch import Tensor

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
class FilteredImage:
    """An image of 8 bits as a PNG file holds it before it is compressed, such as a GPU makes it (see filtered_rows).

    rows: uint8 [H, 1 + W C]. channels: C, 1, 3 or 4.
    """

    rows: np.ndarray
    channels: int
    dtype = np.dtype(np.uint8)
    ndim = 3

    @property
    def shape(self) -> tuple[int, int, int]:
        """H, W, C."""
        height, size = self.rows.shape
        return height, (size - 1) // self.channels, self.channels

    @property
    def is_plain(self) -> bool:
        """Whether the image has one colour."""
        first = self.rows[0, 1:].reshape(-1, self.channels)
        below = (self.rows[1::64, 1::16], self.rows[1:, 1:])  # a look at few of them tells of most images
        return bool((first == first[0]).all()) and not any(part.any() for part in below)


def filtered_rows(pixels: Tensor) -> Tensor:
    """The rows of a FilteredImage, from pixels uint8 [H, W, C] on any device."""
    import torch

    rows = pixels.reshape(len(pixels), -1)
    out = rows.new_empty(len(rows), 1 + rows.shape[1])
    out[:, 0] = _UP
    out[0, 1:] = rows[0]
    torch.sub(rows[1:], rows[:-1], out=out[1:, 1:])
    return out


def write_png(path: Path, image: np.ndarray | FilteredImage, texts: Mapping[str, str]) -> None:
    """Writes [H, W, C], uint8 or uint16, C = 1, 3 or 4, alpha straight, as sRGB. texts: by their keywords, Latin-1.

    A filtered image becomes the same bytes as its pixels. Nothing is checked, and the file grows as it is written.
    Raises OSError.
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
        for part in _compressed(image):
            _write(file, b"IDAT", part)
        _write(file, b"IEND", b"")


def _compressed(image: np.ndarray | FilteredImage) -> Iterator[bytes]:
    """The zlib stream of the filtered rows, in parts."""
    from isal import isal_zlib

    stream = isal_zlib.compressobj(_LEVEL)
    for block in _blocks(image):
        if part := stream.compress(block):
            yield part
    yield stream.flush()


def _blocks(image: np.ndarray | FilteredImage) -> Iterator[np.ndarray]:
    """The filtered rows, some at a time; each holds until the next."""
    if isinstance(image, FilteredImage):
        count = _rows_at_once(image.rows.shape[1])
        yield from (image.rows[first : first + count] for first in range(0, len(image.rows), count))
        return
    rows = np.ascontiguousarray(image, image.dtype.newbyteorder(">")).reshape(len(image), -1).view(np.uint8)
    count = _rows_at_once(1 + rows.shape[1])
    filtered = np.empty((min(count, len(rows)), 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = _UP
    for first in range(0, len(rows), count):
        block = rows[first : first + count]
        out = filtered[: len(block), 1:]
        np.subtract(block[1:], block[:-1], out=out[1:])
        out[0] = block[0] - (rows[first - 1] if first else 0)
        yield filtered[: len(block)]


def _rows_at_once(row_bytes: int) -> int:
    return max(1, _BLOCK_BYTES // row_bytes)


def _write(file: BinaryIO, kind: bytes, data: bytes) -> None:
    """A chunk: length, type, data and checksum."""
    from isal import isal_zlib

    file.write(struct.pack(">I", len(data)) + kind)
    file.write(data)
    file.write(struct.pack(">I", isal_zlib.crc32(data, isal_zlib.crc32(kind))))
