"""Files that came in place of the one that was meant: what a clone or a download leaves where it did not fetch it."""

from __future__ import annotations

import re
from pathlib import Path

from lightfield_gs.base.errors import InputError

_START_BYTES = 512
_LARGE_BYTES = 64 << 20  # smaller files are read in no time, whatever they are
# What images begin with, those of cameras among them; of TGA, which says nothing, what its kinds have (bytes 1 and 2)
_IMAGE_STARTS = re.compile(
    rb"\x89PNG|\xff\xd8\xff|v/1\x01|II|MM|GIF8|BM|RIFF|#\?|P[1-7Ff]|SDPX|XPDS|\x80\x2a\x5f\xd7|\xd7\x5f\x2a\x80|8BPS|"
    rb"....(?:ftyp|jP  |JXL )|\xff\x0a|\xff\x4f\xff\x51|DDS |\x01\xda|FOR[48]|SIMPLE|FUJIFILM|FOVb|"
    rb"\x00MRM|\x00\x00[\x01\x02]\x00|\x59\xa6\x6a\x95|\x2f\x08\x67\xab|\x53\x80\xf6\x34|.[\x00\x01][\x01-\x03\x09-\x0b]",
    re.DOTALL,
)
_POINTER = b"version https://git-lfs.github.com/spec/"
# Comments may come first; <Error> is what storage servers answer, in XML
_WEB_PAGE = re.compile(rb"(?:\xef\xbb\xbf)?\s*<(?:.*<)?(?:!doctype html|html[\s>]|error>)", re.IGNORECASE | re.DOTALL)


def refuse_large_no_image(path: Path) -> None:
    """Raises InputError where a large file does not begin as images do: for a reader that would look all through it."""
    if path.stat().st_size > _LARGE_BYTES and not _IMAGE_STARTS.match(start := _start(path)):
        refuse_stand_in(path)
        raise InputError(f"{path} is not an image that can be read: no format begins with {start[:8].hex(' ')} (hex)")


def _start(path: Path) -> bytes:
    with open(path, "rb") as file:
        return file.read(_START_BYTES)


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
