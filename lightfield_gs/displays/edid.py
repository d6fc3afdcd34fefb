"""EDID, the block of bytes in which a screen tells its name, its serial number and its size (VESA E-EDID 1.4)."""

from __future__ import annotations

from dataclasses import dataclass

_HEADER = b"\x00\xff\xff\xff\xff\xff\xff\x00"
_BLOCK = 128
_DESCRIPTORS = (54, 72, 90, 108)  # 18 bytes each
_TEXTS = {0xFC: "name", 0xFF: "serial"}


@dataclass(frozen=True)
class Edid:
    """What a screen tells of itself.

    Attributes:
        maker: Three letters of its maker.
        name: Its name; "" without one.
        serial: Its serial number as text; "" without one.
        size_px: Width and height of its preferred mode; None without one.
        size_mm: Width and height of its picture; None where not told.
    """

    maker: str
    name: str
    serial: str
    size_px: tuple[int, int] | None
    size_mm: tuple[int, int] | None


def parse_edid(data: bytes) -> Edid | None:
    """Return what the first block tells; None for bytes that are none, or damaged ones."""
    block = data[:_BLOCK]
    if len(block) < _BLOCK or not block.startswith(_HEADER) or sum(block) % 256:
        return None
    letters = int.from_bytes(block[8:10], "big")
    maker = "".join(chr(ord("A") - 1 + (letters >> shift & 31)) for shift in (10, 5, 0))
    number = int.from_bytes(block[12:16], "little")
    texts = {"name": "", "serial": ""}
    size_px = size_mm = None
    for start in _DESCRIPTORS:
        part = block[start : start + 18]
        if part[0] or part[1]:
            if size_px is None:
                size_px = part[2] | (part[4] >> 4) << 8, part[5] | (part[7] >> 4) << 8
                size_mm = part[12] | (part[14] >> 4) << 8, part[13] | (part[14] & 15) << 8
        elif part[3] in _TEXTS:
            texts[_TEXTS[part[3]]] = part[5:].split(b"\n")[0].decode("latin-1").strip()
    if not (size_mm and all(size_mm)):
        size_mm = (10 * block[21], 10 * block[22]) if block[21] and block[22] else None
    return Edid(maker, texts["name"], texts["serial"] or (str(number) if number else ""), size_px, size_mm)
