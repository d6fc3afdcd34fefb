"""Files that appear complete or not at all, and the folders they go to."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.paths import checked_path

_TEMPORARY = re.compile(r"\..*\.[0-9a-f]{12}(\.[^.]*)?")  # names that atomic_path makes


def check_output_path(path: str | Path) -> Path:
    """`path`, if a file can be written there; raises InputError before any long work is done for nothing."""
    path = checked_path(path)
    if path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder; give a file name")
    if path.exists() and not path.is_file():
        raise InputError(f"cannot write {path}: it is a device or a pipe; give a file name")
    folder = _target(path).parent
    if not folder.is_dir():
        raise InputError(f"cannot write {path}: there is no folder {folder}; create it first")
    if not os.access(folder, os.W_OK):
        raise InputError(f"cannot write {path}: no permission to write in {folder}")
    return path


def _target(path: Path) -> Path:
    """The file that is written: where a symbolic link leads, which stays."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def check_outputs(outputs: Iterable[str | Path | None], inputs: Iterable[str | Path | None] = ()) -> None:
    """Raises InputError where a command would write over a file that it reads, or twice over the same.

    None stands for a file that was not given.
    """
    read = [checked_path(path) for path in inputs if path is not None]
    written: list[Path] = []
    for path in (checked_path(path) for path in outputs if path is not None):
        if any(_is_same_file(path, other) for other in read):
            raise InputError(f"{path} is also an input; give the output another name")
        if any(_is_same_file(path, other) for other in written):
            raise InputError(f"{path} is named for two outputs; give each a name of its own")
        written.append(path)


def _is_same_file(one: Path, other: Path) -> bool:
    """Whether two paths name one file, perhaps through links; of absent files, whether they would be one."""
    try:
        return os.path.samefile(one, other)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(other)


def make_folder(path: str | Path) -> Path:
    """`path`, made with the folders above it where they are absent. Raises InputError where it cannot be a folder."""
    path = checked_path(path)
    if os.path.exists(path) and not path.is_dir():
        raise InputError(f"cannot make the folder {path}: it is a file; give a folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {path}: {error.strerror or error}") from error
    return path


def check_folder(path: str | Path) -> Path:
    """`path`, if it is a folder for files, or can be made one; raises InputError before any long work is done.

    Only trying tells (/proc takes no folders even of root); nothing is left of the trial.
    """
    path = checked_path(path)
    absent = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        make_folder(path)
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        raise InputError(f"cannot write in {path}: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):  # not made, or somebody else's by now
            for folder in absent:
                folder.rmdir()
    return path


def remove_file(path: Path) -> None:
    """Removes a file where there is one. Raises InputError where it cannot be removed."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot remove {path}: {error.strerror or error}") from error


def remove_left_over(folder: Path) -> None:
    """Removes what atomic_path left in a folder, and in those below, of processes that were killed. Raises InputError.
    Nothing else may be writing there."""
    for place, _, names in os.walk(folder):
        for name in names:
            if _TEMPORARY.fullmatch(name):
                remove_file(Path(place) / name)


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path in the folder of `path`, with its extension; renamed to `path` at the end, removed on failure.

    Where `path` is a symbolic link, all this holds for the file that it leads to. Raises InputError where the folder
    cannot be written to, the disk is full, or `path` is a device or a pipe.
    """
    path = check_output_path(path)
    target = _target(path)
    temporary = target.with_name(f".{path.stem[:64]}.{secrets.token_hex(6)}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_new_folder(path: str | Path) -> Path:
    """`path`, if there is nothing yet, or an empty folder; raises InputError before any long work is done."""
    path = checked_path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path} exists: remove it, or name another folder")
    return path


@contextlib.contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside `path`; renamed to it at the end, removed with all that is in it on failure.

    Raises InputError where there is a folder that is not empty, or it cannot be written.
    """
    path = check_new_folder(path)
    temporary = make_folder(path.parent) / f".{path.name}.{secrets.token_hex(6)}"
    try:
        make_folder(temporary)
        yield temporary
        if path.exists():
            path.rmdir()  # it is empty; Windows renames no folder to one that is there
        os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
