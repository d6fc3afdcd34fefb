"""PNG files: damage in their chunks, their colour space, and compression by a CPU or by the CUDA device of an image.

ISA-L's deflate is three times as fast as zlib.

Source: Portable Network Graphics (PNG) Specification (Third Edition), W3C, 2025. A chunk is a length, a type of four
letters, that many bytes, and the CRC of type and bytes (section 5.3). Chunks whose type begins with a capital letter
are critical. Filters: section 9.2; chunks of colour and text: section 11.
"""

from __future__ import annotations

import io
import mmap
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from lightfield_gs.base.options import Compression

if TYPE_CHECKING:
    from torch import Tensor

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_LONGEST_CHUNK = 2**31 - 1
_HEADER = struct.Struct(">IIBBBBB")
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_LARGEST_UNPACKED = 4 << 20
_LETTERS = frozenset(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz")
_COLOUR_TYPES = {1: 0, 3: 2, 4: 6}  # by channels: grey, RGB, RGB with alpha
_UP = 2  # the filter that subtracts the pixel above
_ZLIB_HEADER = b"\x78\x01"  # deflate with a window of 32 KB, by a fast algorithm (RFC 1950, section 2.2)
_LONGEST_STORED = 0xFFFF  # bytes of a stored block of deflate
_LEVEL = 1  # of ISA-L's 0..3: files as large as zlib's; higher levels cost time and save nothing
# Bytes compressed at once: a few calls an image, since threads of Python take turns between calls
_BLOCK_BYTES = 1 << 24
# sRGB, and gamma and primaries for readers that do not know sRGB
_SRGB = {
    b"sRGB": b"\0",
    b"gAMA": struct.pack(">I", 45455),
    b"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000),
}


def png_damage(path: Path, pixels: bool) -> str | None:
    """Describe the damage to the chunks of a PNG; return None for a whole PNG and for other files.

    libpng is given whole chunks only, since it prints its findings on stderr.

    Args:
        path: the file.
        pixels: check the pixel data too. Of images of more than 4 MiB their unpacked size is not checked: that takes as
            long as reading them.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        if file.read(len(_SIGNATURE)) != _SIGNATURE:
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data, memoryview(data) as view:
            return _damage(view, pixels)


def _damage(data: memoryview, pixels: bool) -> str | None:
    position, least_bytes = len(_SIGNATURE), 0
    packed: list[tuple[int, int]] = []
    while position + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        name = kind.decode("ascii", errors="backslashreplace")
        if packed and kind != b"IDAT" or kind == b"IDAT" and not pixels:
            break  # libpng reads the rest silently, or not at all
        if not _LETTERS.issuperset(kind) or length > _LONGEST_CHUNK:
            return f"a chunk has no proper header, but '{name}' and the length {length}"
        body, end = position + 8, position + 8 + length
        if end + 4 > len(data):
            return f"it ends within its chunk {name}"
        if kind[:1].isupper() and zlib.crc32(data[position + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            return f"the checksum of its chunk {name} is wrong"
        if kind == b"IHDR" and length == _HEADER.size:
            width, height, bits, colour, *_, interlaced = _HEADER.unpack_from(data, body)
            if not (width and height):
                return f"its size is {width} x {height} pixels"
            least_bytes = 0 if interlaced else height * (1 + (width * bits * _CHANNELS.get(colour, 1) + 7) // 8)
        if kind == b"IDAT":
            packed.append((body, end))
        position = end + 4
    if not pixels:
        return None
    if not packed:
        return "it ends before its pixels"
    return None if least_bytes > _LARGEST_UNPACKED else _unpacking_damage(data, packed, least_bytes)


def _unpacking_damage(data: memoryview, packed: list[tuple[int, int]], least_bytes: int) -> str | None:
    unpacker, found = zlib.decompressobj(), 0
    try:
        for begin, end in packed:
            found += len(unpacker.decompress(data[begin:end], least_bytes + 1 - found))
            if found >= least_bytes:
                return None
    except zlib.error:
        return "its pixels do not unpack"
    return f"its pixels are {found} of {least_bytes} bytes"


def png_colour(path: Path) -> dict[str, Any]:
    """Return the colour space of a PNG where OpenImageIO does not, by OpenImageIO's names; {} for damaged files.

    "ICCProfile" is returned even where it is broken; "chromaticities" are x and y of red, green, blue and white.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # nothing is decoded
            with Image.open(path, formats=["PNG"]) as image:
                info = image.info
    except (OSError, ValueError, SyntaxError, MemoryError, Image.DecompressionBombError):
        return {}
    colour: dict[str, Any] = {}
    if info.get("icc_profile"):
        colour["ICCProfile"] = info["icc_profile"]
    elif "chromaticity" in info and "srgb" not in info:
        white, rest = info["chromaticity"][:2], info["chromaticity"][2:]
        colour["chromaticities"] = (*rest, *white)
    return colour


@dataclass(frozen=True)
class CompressedImage:
    """An 8-bit image that is compressed already, such as by a GPU.

    Attributes:
        shape: H, W, C with C = 1, 3 or 4.
        stream: zlib stream of the filtered rows, in parts.
        is_plain: whether all pixels have one colour.
    """

    shape: tuple[int, ...]
    stream: Sequence[bytes | memoryview]
    is_plain: bool
    dtype = np.dtype(np.uint8)
    ndim = 3


def write_png(path: Path, image: np.ndarray | CompressedImage, texts: Mapping[str, str]) -> None:
    """Write a PNG file as sRGB; nothing is checked, and the file grows as it is written.

    Args:
        path: the file.
        image: [H, W, C], uint8 or uint16, C = 1, 3 or 4, straight alpha.
        texts: Latin-1 texts by keyword.

    Raises:
        OSError: the file cannot be written.
    """
    height, width, channels = image.shape
    with path.open("wb") as file:
        file.write(_SIGNATURE)
        header = (width, height, 8 * image.dtype.itemsize, _COLOUR_TYPES[channels], 0, 0, 0)
        _write_chunk(file, b"IHDR", struct.pack(">IIBBBBB", *header))
        for kind, data in _SRGB.items():
            _write_chunk(file, kind, data)
        for keyword, text in texts.items():
            _write_chunk(file, b"tEXt", f"{keyword}\0{text}".encode("latin-1", "replace"))
        for part in image.stream if isinstance(image, CompressedImage) else _compress(image):
            _write_chunk(file, b"IDAT", part)
        _write_chunk(file, b"IEND", b"")


def stored_png(pixels: np.ndarray) -> memoryview:
    """Return a PNG file without compression and without a colour profile: the fastest that has each byte.

    Each row is a stored block of deflate (RFC 1951, 3.2.4), so that the pixels are copied once. Rows that are too long
    for a block are packed by zlib, in more time.

    Args:
        pixels: [H, W, 3], uint8.
    """
    from isal import isal_zlib

    height, width, channels = pixels.shape
    size = 1 + channels * width  # of a row: its filter, none, and its bytes
    header = _HEADER.pack(width, height, 8, _COLOUR_TYPES[channels], 0, 0, 0)
    start, end = _SIGNATURE + _chunk(b"IHDR", header), _chunk(b"IEND", b"")
    if size > _LONGEST_STORED:
        filtered = np.zeros((height, size), np.uint8)
        filtered[:, 1:] = pixels.reshape(height, -1)
        return memoryview(start + _chunk(b"IDAT", zlib.compress(filtered.data, 0)) + end)
    start += struct.pack(">I", 2 + height * (5 + size) + 4) + b"IDAT" + _ZLIB_HEADER
    first = len(start)
    file = np.empty(first + height * (5 + size) + 8 + len(end), np.uint8)
    file[:first] = np.frombuffer(start, np.uint8)
    rows = file[first : first + height * (5 + size)].reshape(height, 5 + size)
    rows[:, :6] = np.frombuffer(struct.pack("<BHHB", 0, size, size ^ _LONGEST_STORED, 0), np.uint8)
    rows[-1, 0] = 1  # the last block
    rows[:, 6:] = pixels.reshape(height, -1)
    sum_of_rows = 1
    for row in rows:
        sum_of_rows = isal_zlib.adler32(row[5:], sum_of_rows)
    after = first + rows.size
    file[after : after + 4] = np.frombuffer(struct.pack(">I", sum_of_rows), np.uint8)
    check = isal_zlib.crc32(file[first - 6 : after + 4])
    file[after + 4 :] = np.frombuffer(struct.pack(">I", check) + end, np.uint8)
    return file.data


def _chunk(kind: bytes, data: bytes) -> bytes:
    file = io.BytesIO()
    _write_chunk(file, kind, data)
    return file.getvalue()


def _compress(pixels: np.ndarray) -> Iterator[bytes]:
    """Yield the zlib stream of the filtered rows."""
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


def _write_chunk(file: BinaryIO, kind: bytes, data: bytes | memoryview) -> None:
    """Write a chunk: length, type, data and checksum."""
    from isal import isal_zlib

    file.write(struct.pack(">I", len(data)) + kind)
    file.write(data)
    file.write(struct.pack(">I", isal_zlib.crc32(data, isal_zlib.crc32(kind))))


def is_deflated_on_gpu(image: Tensor, path: Path, compression: Compression) -> bool:
    """Tell whether an image is compressed on its CUDA device for the file at `path`.

    An H100 compresses an 8K image in a millisecond, a CPU core in a tenth of a second or more. At most a third of the
    bytes are copied to the host.
    """
    import torch

    is_compressed = path.suffix.lower() == ".png" and compression == "fast"
    return image.is_cuda and image.dtype == torch.uint8 and is_compressed


def fetch_image(image: Tensor, path: Path, compression: Compression) -> np.ndarray | CompressedImage:
    """Copy an image [H, W, C] to the host in the form that write_image takes for this file; wait for it."""
    from lightfield_gs.base.device import to_numpy

    if not is_deflated_on_gpu(image, path, compression):
        return to_numpy(image)
    out, facts = deflate(image)
    return compressed_image(tuple(image.shape), out, to_numpy(facts))


def deflate(image: Tensor) -> tuple[Tensor, Tensor]:
    """Compress an image's filtered rows on its device, without waiting; see csrc/cuda/png/png.h.

    Args:
        image: uint8 [H, W, C], contiguous, on a CUDA device.

    Returns:
        A buffer that begins with the deflate stream, and the facts that `compressed_image` needs; both uint8, on the
        image's device.
    """
    import torch

    from lightfield_gs import _core
    from lightfield_gs.base.device import device_guard

    height, width, channels = image.shape
    native = _core.cuda.PngImage(height=height, width=width, channels=channels, pixels=image.data_ptr())
    work, out = (image.new_empty(size) for size in (native.work_bytes(), native.stream_bytes()))
    native.place(work.data_ptr(), out.data_ptr())
    with device_guard(image.device):
        _core.cuda.deflate(native, torch.cuda.current_stream(image.device).cuda_stream)
    return out, work[: _core.cuda.DEFLATE_FACTS_BYTES]


def compressed_image(shape: tuple[int, ...], out: Tensor, facts: np.ndarray) -> CompressedImage:
    """Copy the stream of `deflate` to the host; wait for this copy alone, on the current CUDA stream.

    Args:
        shape: H, W, C of the image.
        out: buffer of the stream, on the device.
        facts: facts of the stream, on the host already.
    """
    from lightfield_gs.base.device import to_numpy

    bits, adler, is_varied = struct.unpack("QII", facts.tobytes())
    stream = to_numpy(out[: (bits + 7) // 8])
    return CompressedImage(shape, (_ZLIB_HEADER, stream.data, struct.pack(">I", adler)), not is_varied)
