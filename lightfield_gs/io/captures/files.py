"""Finding the files that a set names, whatever system wrote the names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.views import IMAGE_SUFFIXES


def named_image(field: str, folder: Path, name: Any) -> Path:
    """The image in or below `folder` that a data file names: with / or \\ between folders, with or without its
    extension, in whatever case.

    field: where the name stands, for messages. Raises InputError where there is none, or several that differ in case.
    """
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"{field}: expected the name of an image, got {shown(name)}")
    try:
        return _found(field, folder, name)
    except (OSError, UnicodeEncodeError) as error:
        raise InputError(f"{field}: {shown(name)}: {error.args[-1]}") from None


def _found(field: str, folder: Path, name: str) -> Path:
    """What named_image finds; raises OSError or UnicodeEncodeError for a name that no file can have."""
    base = (folder / name).resolve()
    if not base.is_file():  # Windows wrote it, unless the file's own name has a backslash
        base = (folder / name.replace("\\", "/")).resolve()
    if not base.is_relative_to(folder.resolve()):
        raise InputError(f"{field}: {shown(name)} leads out of {folder}; put the images into that folder")
    for exact in (True, False):
        found = _files_named(base, exact)
        if len(found) > 1:
            names = " or ".join(path.name for path in found[:3])
            raise InputError(f"{field}: {shown(name)} may be {names}: rename one")
        if found:
            return found[0]
    raise InputError(
        f"{field}: missing image {base}: expected such a file, or with one of {', '.join(IMAGE_SUFFIXES)} added"
    )


def _files_named(base: Path, exact: bool) -> list[Path]:
    """Images of this name, with its extension or the first of IMAGE_SUFFIXES that there is; or, if not `exact`, of
    names that differ from it in case only, of folders too."""
    names = [base.name + suffix for suffix in ("", *IMAGE_SUFFIXES)]
    if exact:
        found = [base.with_name(name) for name in names]
        return [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()][:1]
    entries = [
        entry
        for folder in _folders_named(base.parent)
        for entry in sorted(folder.iterdir())
        if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file()
    ]
    for name in names:
        if found := [entry for entry in entries if entry.name.lower() == name.lower()]:
            return found
    return []


def _folders_named(folder: Path) -> list[Path]:
    """This folder; where there is none, those whose paths differ from it in case only."""
    if folder.is_dir() or folder.parent == folder:
        return [folder]
    return [
        entry
        for parent in _folders_named(folder.parent)
        for entry in sorted(parent.iterdir())
        if entry.name.lower() == folder.name.lower() and entry.is_dir()
    ]
