"""XMP metadata of JPEG files, also where it is longer than one segment.

Source: XMP Specification Part 3 (Adobe, 2020), section 1.1.3. XMP is in segments APP1 that begin with the name of its
namespace. XMP of more than 64 KB continues in segments with a GUID, the total length and the offset of each part.
"""

from __future__ import annotations

import mmap
import re
import struct
from pathlib import Path

_XMP, _EXTENDED = b"http://ns.adobe.com/xap/1.0/\0", b"http://ns.adobe.com/xmp/extension/\0"
_PARTS = struct.Struct(">32sII")  # GUID, total length, offset of this part
_APP1, _SCAN, _END = 0xE1, 0xDA, 0xD9
_MOST_BYTES = 256 << 20
_LONE = (*range(0xD0, 0xD8), 0x01)  # markers without a length


def jpeg_xmp(path: Path) -> str:
    """Return the XMP of a JPEG, followed by its extension; "" without XMP and for other files.

    Attributes are in double quotes; exiftool writes single ones.

    Raises:
        OSError: the file cannot be read.
    """
    with open(path, "rb") as file:
        if file.read(2) != b"\xff\xd8":
            return ""
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            packets, parts, size = list[bytes](), dict[bytes, dict[int, bytes]](), 0
            for start, end in _app1_segments(data):
                if data[start : start + len(_XMP)] == _XMP:
                    packets.append(data[start + len(_XMP) : end])
                elif data[start : start + len(_EXTENDED)] == _EXTENDED and end - start >= len(_EXTENDED) + _PARTS.size:
                    guid, _, offset = _PARTS.unpack_from(data, start + len(_EXTENDED))
                    parts.setdefault(guid, {})[offset] = data[start + len(_EXTENDED) + _PARTS.size : end]
                size += end - start
                if size > _MOST_BYTES:
                    break
    # The extension that the XMP names, where programs left those of earlier versions
    named = [own for guid, own in parts.items() if any(guid in packet for packet in packets)]
    extensions = [b"".join(own[offset] for offset in sorted(own)) for own in named or parts.values()]
    xmp = b"\n".join([*packets, *extensions]).decode(errors="replace")
    return re.sub(r"=\s*'([^'\"<>]*)'", r'="\1"', xmp)


def _app1_segments(data: mmap.mmap) -> list[tuple[int, int]]:
    """Return begin and end of the contents of the segments APP1 before the first scan."""
    found, position = [], 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xFF or marker in _LONE:
            position += 1 if marker == 0xFF else 2
            continue
        end = position + 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker in (_SCAN, _END) or end > len(data):
            break
        if marker == _APP1:
            found.append((position + 4, end))
        position = max(end, position + 4)
    return found
