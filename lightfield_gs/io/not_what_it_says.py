"""Files that came in place of the one that was meant: what a clone or a download leaves where it did not fetch it."""

from __future__ import annotations

import re
from pathlib import Path

from lightfield_gs.base.errors import InputError

_START_BYTES = 512
_POINTER = b"version https://git-lfs.github.com/spec/"
# Comments may come first; <Error> is what storage servers answer, in XML
_WEB_PAGE = re.compile(rb"(?:\xef\xbb\xbf)?\s*<(?:.*<)?(?:!doctype html|html[\s>]|error>)", re.IGNORECASE | re.DOTALL)


def refuse_stand_in(path: Path) -> None:
    """Raises InputError where the file is a Git LFS pointer or a web page: for readers that cannot make sense of it."""
    try:
        with open(path, "rb") as file:
            start = file.read(_START_BYTES)
    except OSError:
        return  # whoever calls has a complaint of their own
    if start.startswith(_POINTER):
        raise InputError(f"{path} is a Git LFS pointer, not the file itself; fetch it with `git lfs pull`")
    if _WEB_PAGE.match(start):
        raise InputError(
            f"{path} is a web page (HTML), not the file itself; download it again, by the link of the raw file"
        )
