"""Write JPEG files of stereo pairs: MPO with two pictures, and JPS with both in one.

Sources: Multi-Picture Format (CIPA DC-007, 2009), where segment APP2 of the first picture lists all; JPS, whose segment
APP3 describes its two halves (Siragusa, Swift, "General purpose stereoscopic data descriptor", VRex, 1997).
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.io.atomic import atomic_path

_QUALITY = 95
_DESCRIPTION = 0x010E  # of Exif
_APP2, _APP3 = b"\xff\xe2", b"\xff\xe3"
_DISPARITY, _REPRESENTATIVE = 0x020002, 1 << 29  # kind of a picture, and the flag of the one to show alone
_ENTRY_BYTES, _HEADER_BYTES = 16, 50  # of a picture in the list, and of what stands before the list
JPS_NAME = b"_JPSJPS_"
JPS_SIDE_BY_SIDE, JPS_LEFT_FIRST = 2, 4  # layout of a stereoscopic JPS, and a flag of it


def write_jpeg(path: Path, pixels: np.ndarray, metadata: dict[str, str]) -> None:
    """Write an image uint8 [H, W, 3] as a JPEG; of the name .jps as one whose left half is the left eye's.

    Args:
        path: The file.
        pixels: [H, W, 3].
        metadata: Stored as in write_image.

    Raises:
        InputError: The file cannot be written.
    """
    data = _jpeg(pixels, metadata)
    if path.suffix.lower() == ".jps":
        # A length of the descriptor, its bytes from high to low: separation, flags, layout, and 1 for stereoscopic
        words = struct.pack(">HBBBBH", 4, 0, JPS_LEFT_FIRST, JPS_SIDE_BY_SIDE, 1, 0)
        data = _with_segment(data, _APP3, JPS_NAME + words)
    _write(path, [data])


def write_mpo(path: Path, eyes: Sequence[np.ndarray], metadata: dict[str, str]) -> None:
    """Write the pictures of two eyes, the left one's first, each uint8 [H, W, 3], as an MPO.

    Args:
        path: The file.
        eyes: Two pictures of one size.
        metadata: Stored in the first picture as in write_image.

    Raises:
        InputError: The file cannot be written.
    """
    first, second = (_jpeg(eye, metadata if number == 0 else {}) for number, eye in enumerate(eyes))
    start = _after_exif(first)
    added = len(_segment(_APP2, b"MPF\0" + _list_of_pictures([0, 0], [0, 0])))
    origin = start + 4 + 4  # offsets count from the list's own header
    sizes, offsets = [len(first) + added, len(second)], [0, len(first) + added - origin]
    _write(path, [_with_segment(first, _APP2, b"MPF\0" + _list_of_pictures(sizes, offsets)), second])


def _list_of_pictures(sizes: Sequence[int], offsets: Sequence[int]) -> bytes:
    """Return the MP Index IFD, little-endian: version, number of pictures, and the entries."""
    rows = struct.pack("<2sHI", b"II", 42, 8) + struct.pack("<H", 3)
    rows += struct.pack("<HHI4s", 0xB000, 7, 4, b"0100")
    rows += struct.pack("<HHII", 0xB001, 4, 1, len(sizes))
    rows += struct.pack("<HHIII", 0xB002, 7, _ENTRY_BYTES * len(sizes), _HEADER_BYTES, 0)
    kinds = [_REPRESENTATIVE | _DISPARITY, *[_DISPARITY] * (len(sizes) - 1)]
    return rows + b"".join(struct.pack("<IIIHH", *entry, 0, 0) for entry in zip(kinds, sizes, offsets))


def _jpeg(pixels: np.ndarray, metadata: dict[str, str]) -> bytes:
    from PIL import Image

    exif = Image.Exif()
    if metadata:
        exif[_DESCRIPTION] = json.dumps(metadata)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=_QUALITY, subsampling=0, exif=exif)
    return file.getvalue()


def _segment(marker: bytes, content: bytes) -> bytes:
    return marker + struct.pack(">H", 2 + len(content)) + content


def _with_segment(data: bytes, marker: bytes, content: bytes) -> bytes:
    """Return a JPEG with a segment after those of JFIF and Exif, where readers look for it."""
    at = _after_exif(data)
    return data[:at] + _segment(marker, content) + data[at:]


def _after_exif(data: bytes) -> int:
    at = 2
    while data[at : at + 2] in (b"\xff\xe0", b"\xff\xe1"):
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return at


def _write(path: Path, parts: Sequence[bytes]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"".join(parts))
