"""Whether the chunks of a PNG are whole, before libpng is given them: it prints what it finds on stderr by itself.

Source: Portable Network Graphics (PNG) Specification (Third Edition), W3C, 2025, section 5.3: a chunk is a length, a
type of four letters, as many bytes, and the CRC of type and bytes. Capital first letters are of chunks that every
reader needs.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from pathlib import Path

SIGNATURE = b"\x89PNG\r\n\x1a\n"
_LONGEST = 2**31 - 1
_HEADER = struct.Struct(">IIBBBBB")
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour type
_LARGEST_UNPACKED = 4 << 20
_LETTERS = frozenset(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz")


def png_damage(path: Path, pixels: bool) -> str | None:
    """What is wrong with the chunks of a PNG, up to its pixels or with these; None for a whole one, and for files that
    are no PNG. Raises OSError.

    Of images of more than 4 MiB it is not looked whether their pixels unpack to as many as there must be: that would
    take as long as reading them.
    """
    with open(path, "rb") as file:
        if file.read(len(SIGNATURE)) != SIGNATURE:
            return None
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data, memoryview(data) as view:
            return _damage(view, pixels)


def _damage(data: memoryview, pixels: bool) -> str | None:
    place, least_bytes = len(SIGNATURE), 0
    packed: list[tuple[int, int]] = []
    while place + 8 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, place)
        name = kind.decode("ascii", errors="backslashreplace")
        if packed and kind != b"IDAT" or kind == b"IDAT" and not pixels:
            break  # what comes now, libpng reads without a word, or not at all
        if not _LETTERS.issuperset(kind) or length > _LONGEST:
            return f"a chunk has no proper header, but '{name}' and the length {length}"
        body, end = place + 8, place + 8 + length
        if end + 4 > len(data):
            return f"it ends within its chunk {name}"
        if kind[:1].isupper() and zlib.crc32(data[place + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            return f"the checksum of its chunk {name} is wrong"
        if kind == b"IHDR" and length == _HEADER.size:
            width, height, bits, colour, *_, interlaced = _HEADER.unpack_from(data, body)
            if not (width and height):
                return f"its size is {width} x {height} pixels"
            least_bytes = 0 if interlaced else height * (1 + (width * bits * _CHANNELS.get(colour, 1) + 7) // 8)
        if kind == b"IDAT":
            packed.append((body, end))
        place = end + 4
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
