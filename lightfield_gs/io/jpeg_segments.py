"""XMP in JPEG files, also where it is longer than a segment.

Source: XMP Specification Part 3 (Adobe, 2020), section 1.1.3: segments APP1 that begin with the name of the namespace;
what is longer than 64 KB comes in segments with a GUID, the whole length and the place of each part.
"""

from __future__ import annotations

import mmap
import re
import struct
from pathlib import Path

_XMP, _EXTENDED = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_PARTS = struct.Struct(">32sII")  # GUID, length of the whole, place of this part
_APP1, _SCAN, _END = 0xE1, 0xDA, 0xD9
_MOST_BYTES = 256 << 20
_LONE = (*range(0xD0, 0xD8), 0x01)  # markers without a length


def xmp_of_jpeg(path: Path) -> str:
    """The XMP of a JPEG, with its extension behind it; "" where there is none, and of other files. Raises OSError.

    Attributes are in double quotes, though files may have single ones, as of exiftool."""
    with open(path, "rb") as file:
        if file.read(2) != b"\xff\xd8":
            return ""
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            packets, parts, size = [], {}, 0
            for start, end in _app1_segments(data):
                if data[start : start + len(_XMP)] == _XMP:
                    packets.append(data[start + len(_XMP) : end])
                elif data[start : start + len(_EXTENDED)] == _EXTENDED and end - start >= len(_EXTENDED) + _PARTS.size:
                    _, _, place = _PARTS.unpack_from(data, start + len(_EXTENDED))
                    parts[place] = data[start + len(_EXTENDED) + _PARTS.size : end]
                size += end - start
                if size > _MOST_BYTES:
                    break
    xmp = b"\n".join([*packets, b"".join(parts[place] for place in sorted(parts))]).decode(errors="replace")
    return re.sub(r"=\s*'([^'\"<>]*)'", r'="\1"', xmp)


def _app1_segments(data: mmap.mmap) -> list[tuple[int, int]]:
    """Where the contents of the segments APP1 begin and end, up to the first scan."""
    found, place = [], 2
    while place + 4 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF or marker in _LONE:
            place += 1 if marker == 0xFF else 2
            continue
        end = place + 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        if marker in (_SCAN, _END) or end > len(data):
            break
        if marker == _APP1:
            found.append((place + 4, end))
        place = max(end, place + 4)
    return found
