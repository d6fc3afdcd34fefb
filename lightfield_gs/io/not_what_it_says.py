"""Files that are not what their names say: what a clone or a download leaves in place of a file, and videos."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Literal

from lightfield_gs.base.errors import InputError

VIDEO_INPUTS = (
    *(".mp4", ".mkv", ".mov", ".webm", ".avi", ".m4v", ".f4v", ".qt", ".asf", ".mxf"),
    *(".mts", ".m2ts", ".m2t", ".ts", ".mod", ".tod", ".dv", ".vob", ".mpg", ".mpeg", ".m2v"),  # of camcorders and DVDs
    *(".wmv", ".3gp", ".3g2", ".ogv", ".flv"),  # of older phones and the web
)
_START_BYTES = 512
_LARGE_BYTES = 64 << 20  # smaller files are read in no time, whatever they are
# What images begin with, those of cameras among them; of TGA, which says nothing, what its kinds have (bytes 1 and 2),
# and a size
_IMAGE_STARTS = re.compile(
    rb"\x89PNG|\xff\xd8\xff|v/1\x01|II|MM|GIF8|BM|RIFF|#\?|P[1-7Ff]\s+[#\dA-Z]|SDPX|XPDS|\x80\x2a\x5f\xd7|\xd7\x5f\x2a\x80|8BPS|"
    rb"....(?:ftyp|jP  |JXL )|\xff\x0a|\xff\x4f\xff\x51|DDS |\x01\xda|FOR[48]|SIMPLE|FUJIFILM|FOVb|"
    rb"\x00MRM|\x59\xa6\x6a\x95|\x2f\x08\x67\xab|\x53\x80\xf6\x34|"
    rb".(?:\x01[\x01\x09]|[\x00\x01][\x02\x03\x0a\x0b]).{9}(?!\x00\x00)..(?!\x00\x00)..",
    re.DOTALL,
)
# The kinds of these that are compressed, in which no row of zeros is as long as what is looked at behind their headers
_COMPRESSED_STARTS = re.compile(rb"\xff\xd8\xff|GIF8|RIFF|....(?:ftyp|jP  |JXL )|\xff\x0a|\xff\x4f\xff\x51", re.DOTALL)
# The kinds whose headers go on behind the first words: EXR, FITS, RAF, IFF, Softimage and Cineon
_LONG_HEADERS = re.compile(rb"v/1\x01|SIMPLE|FUJIFILM|FOR[48]|\x53\x80\xf6\x34|\x80\x2a\x5f\xd7|\xd7\x5f\x2a\x80")
_FIRST_WORDS = 32  # bytes
_FITS_BLOCK = 2880  # bytes of text (FITS standard 4.0, section 3.3.1)
_PNM_SIZE = re.compile(rb"P[1-6Ff]\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(\d{1,9})\s")
_PNM_PIXEL = 32  # bytes of a pixel at most, as text
_BEHIND_HEADER, _ROW_BYTES = 4096, 1 << 16
_POINTER = b"version https://git-lfs.github.com/spec/"
# Comments may come first; <Error> is what storage servers answer, in XML
_WEB_PAGE = re.compile(rb"(?:\xef\xbb\xbf)?\s*<(?:.*<)?(?:!doctype html|html[\s>]|error>)", re.IGNORECASE | re.DOTALL)

# What videos begin with, and how they are named. HEIC, AVIF, CR3 and JPEG XL are pictures in boxes as MP4 has them
_VIDEOS = (
    (re.compile(rb".{4}(?:ftypqt  |moov|mdat|wide)", re.DOTALL), ".mov"),
    (re.compile(rb".{4}ftyp(?!hei|hev|mif|msf|avif|avis|crx|jx)", re.DOTALL), ".mp4"),
    (re.compile(rb"\x1a\x45\xdf\xa3.{0,60}webm", re.DOTALL), ".webm"),
    (re.compile(rb"\x1a\x45\xdf\xa3"), ".mkv"),
    (re.compile(rb"RIFF.{4}AVI ", re.DOTALL), ".avi"),
    (re.compile(rb"G(?:.{187}G){2}", re.DOTALL), ".ts"),
    (re.compile(rb".{4}G(?:.{191}G){2}", re.DOTALL), ".m2ts"),
    (re.compile(rb"\x00\x00\x01[\xb3\xba]"), ".mpg"),
    (re.compile(rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11"), ".wmv"),
    (re.compile(rb"FLV\x01"), ".flv"),
    (re.compile(rb"OggS"), ".ogv"),
    (re.compile(rb"\x06\x0e\x2b\x34\x02\x05\x01\x01"), ".mxf"),
)


def refuse_large_no_image(path: Path) -> None:
    """Raises InputError where a large file does not begin as images do, or holds zeros behind its header: for a reader
    that would look all through it."""
    if path.stat().st_size <= _LARGE_BYTES:
        return
    start = _start(path, _BEHIND_HEADER + _ROW_BYTES)
    if not _IMAGE_STARTS.match(start):
        refuse_stand_in(path)
        refuse_video(path)
        raise InputError(f"{path} is not an image that can be read: no format begins with {start[:8].hex(' ')} (hex)")
    if _holds_zeros(path, start):
        raise InputError(
            f"{path} is damaged or cut: zeros stand where its picture should be, as a download leaves them that did "
            "not end; download it again"
        )


def _holds_zeros(path: Path, start: bytes) -> bool:
    """Whether zeros stand where the picture of a large image should be, or the rest of its header, by its kind."""
    if _COMPRESSED_STARTS.match(start):
        return not any(start[_BEHIND_HEADER:])
    if start.startswith(b"SIMPLE") and 0 in start[:_FITS_BLOCK]:
        return True
    if _LONG_HEADERS.match(start):
        return not any(start[_FIRST_WORDS:_BEHIND_HEADER])
    if start.startswith((b"II", b"MM")):
        return not _has_directory(path, start)
    size = _PNM_SIZE.match(start)
    return size is not None and _ends_in_zeros(path, len(start) + int(size[1]) * int(size[2]) * _PNM_PIXEL)


def _has_directory(path: Path, start: bytes) -> bool:
    """Whether anything stands where a TIFF says that its first directory is; True of what else begins so."""
    order: Literal["little", "big"] = "little" if start.startswith(b"II") else "big"
    version = int.from_bytes(start[2:4], order)
    if version not in (42, 43):
        return True
    place = int.from_bytes(start[4:8] if version == 42 else start[8:16], order)
    with open(path, "rb") as file:
        file.seek(min(place, path.stat().st_size))
        return any(file.read(8))


def _ends_in_zeros(path: Path, most_bytes: int) -> bool:
    """Whether a file is longer than it needs to be, and zeros are at its end."""
    with open(path, "rb") as file:
        if file.seek(0, os.SEEK_END) <= most_bytes:
            return False
        file.seek(-_ROW_BYTES, os.SEEK_END)
        return not any(file.read())


def _start(path: Path, size: int = _START_BYTES) -> bytes:
    with open(path, "rb") as file:
        return file.read(size)


def refuse_stand_in(path: Path) -> None:
    """Raises InputError where the file is a Git LFS pointer or a web page: for readers that cannot make sense of it."""
    try:
        start = _start(path)
    except OSError:
        return  # whoever calls has a complaint of their own
    if start.startswith(_POINTER):
        raise InputError(f"{path} is a Git LFS pointer, not the file itself; fetch it with `git lfs pull`")
    if _WEB_PAGE.match(start):
        raise InputError(
            f"{path} is a web page (HTML), not the file itself; download it again, by the link of the raw file"
        )


def refuse_video(path: Path) -> None:
    """Raises InputError where the file is a video by its content: for readers of images, which cannot read it."""
    start = _start(path)
    end = next((end for begins, end in _VIDEOS if begins.match(start)), None)
    if end is not None and path.suffix.lower() in VIDEO_INPUTS:
        raise InputError(
            f"{path} is a video, and an image was expected; give a picture of it, or the video to `lightfield-gs video`"
        )
    if end is not None:
        raise InputError(
            f"{path} is a video by its content, and its name says otherwise; rename it to {path.stem}{end}, so that "
            "`lightfield-gs video` and `weave` take its frames"
        )
