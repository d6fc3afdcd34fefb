"""Which photographs of a capture can be read: a download that broke off is found before a fit begins."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.captures.photo_files import RAW_SUFFIXES, Places, too_few
from lightfield_gs.io.images import read_image, read_info

_END_BYTES = 64  # of a file that are looked at
# Formats by their first bytes, and what the last bytes of a whole file hold
_ENDS = ((b"\xff\xd8\xff", b"\xff\xd9"), (b"\x89PNG\r\n\x1a\n", b"IEND"))
_BOXES = b"ftyp"  # at byte 4 of HEIC and AVIF, whose boxes say how long they are
_LINEAR_SUFFIXES = (".exr", ".hdr")


def readable(places: Places, images: Path) -> Places:
    """Those of these photographs that can be read; says which are left out, and that linear ones are encoded.

    Args:
        places: where they are.
        images: the folder that they are in, for messages.

    Raises InputError where too few can be read, with the reason of the first.
    """
    left, reasons = {}, []
    for name, place in places.items():
        try:
            _check(place[1])
        except InputError as error:
            reasons.append(str(error))
        else:
            left[name] = place
    if reasons:
        share = len(reasons), "photograph", len(places)
        if too_few(len(left), len(places)):
            raise InputError(f"{images}: {counted(*share, 'cannot be read')}: {reasons[0]}")
        assume(f"{counted(*share, 'cannot be read and are left out')}: {reasons[0]}")
    if linear := [name for name, path in left.values() if is_linear(path)]:
        assume(
            f"{len(linear)} of {len(places)} photographs hold linear light, as {linear[0]}: it is encoded as sRGB, and "
            "what is brighter than 1 is white"
        )
    return left


def is_linear(path: Path) -> bool:
    """Whether a picture of this name holds linear light, by its format."""
    return path.suffix.lower() in _LINEAR_SUFFIXES


def _check(path: Path) -> None:
    """Raises InputError for a file that is no whole photograph; what looks whole at its end is not decoded."""
    if path.suffix.lower() in RAW_SUFFIXES:
        raise InputError(
            f"{path} is a camera's raw file, a kind that is not read: export the photographs as JPEG, PNG or TIFF of "
            "the size that was posed"
        )
    read_info(path)
    if not _ends_well(path):
        read_image(path, as_stored=True, turn=False)


def _ends_well(path: Path) -> bool:
    """Whether a file ends as whole ones of its format do; false where that cannot be told."""
    with reading(path), path.open("rb") as file:
        start = file.read(16)
        size = file.seek(0, 2)
        if start[4:8] == _BOXES:
            return _last_box_ends(path, size)
        file.seek(max(0, size - _END_BYTES))
        end = file.read()
    if start[:4] == b"RIFF":  # WebP
        return 8 + int.from_bytes(start[4:8], "little") <= size
    return any(start.startswith(begin) and last in end[-2 if len(last) == 2 else 0 :] for begin, last in _ENDS)


def _last_box_ends(path: Path, size: int) -> bool:
    """Whether the boxes of a HEIC or AVIF (ISO/IEC 14496-12, section 4.2) end where the file does, or before."""
    at = 0
    with reading(path), path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            if length == 0:  # as far as the file goes
                return True
            if length < 8:
                return False
            at += length
    return at <= size
