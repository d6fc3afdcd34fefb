"""Files and folders that appear complete or not at all, checks of output paths, locks and checksums."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import itertools
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.paths import checked_path

# Names of what is being written: the stem, a number, the suffix; in versions before, twelve digits for the number
_TEMPORARY = re.compile(r"\..*\.(partial-\d+|[0-9a-f]{12})(\.[^.]*)?", re.DOTALL)
_LOOKED_AT = 4  # so many numbers are looked at for what killed processes left, more where all of them are taken
_HASH_CHUNK_BYTES = 1 << 20
_HAS_LOCKS = importlib.util.find_spec("fcntl") is not None  # not on Windows


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


def lock(file: int, shared: bool = False) -> bool | None:
    """Locks an open file or folder for as long as it is open in this process, however that ends.

    False where another has locked it; None where there are no locks: on Windows, and in some file systems.
    """
    if not _HAS_LOCKS:
        return None
    import fcntl

    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def remove_left_over(folder: Path) -> None:
    """Removes what killed processes left half-written in a folder, and in those below; what is being written stays."""
    for place, folders, names in os.walk(folder):
        for name in filter(_TEMPORARY.fullmatch, [*folders, *names]):
            remove_dead(Path(place) / name)


def remove_dead(path: Path) -> None:
    """Removes a temporary file or folder if the process that wrote it has ended, which frees its lock.

    It stays where that cannot be told, or where it cannot be removed.
    """
    if not _HAS_LOCKS:
        return
    flags = os.O_NOFOLLOW | os.O_NONBLOCK
    with contextlib.suppress(OSError), contextlib.ExitStack() as opened:
        try:
            file = os.open(path, os.O_RDWR | flags)  # NFS locks only what may be written
        except IsADirectoryError:
            file = os.open(path, os.O_RDONLY | flags)
        opened.callback(os.close, file)
        if lock(file) and os.path.samestat(os.fstat(file), os.lstat(path)):
            _remove(path)


def _remove(path: Path) -> None:
    """Removes a file, or a folder with all that is in it, as far as that is allowed."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


@contextlib.contextmanager
def _temporary(target: Path, suffix: str = "", folder_mode: int | None = None) -> Iterator[Path]:
    """A new empty file beside `target`, or a folder with this mode, locked as long as it is written.

    It is removed at the end if it still has its name. What killed processes left of the same target is removed first.
    Raises OSError.
    """
    stem = target.name.removesuffix(suffix)[:64]
    paths = (target.with_name(f".{stem}.partial-{number}{suffix}") for number in itertools.count())
    free = []
    for number, path in enumerate(paths):
        if is_there := os.path.lexists(path):
            remove_dead(path)
        if not os.path.lexists(path):
            free.append(path)
        if number >= _LOOKED_AT - 1 and not is_there:
            break
    for path in itertools.chain(free, paths):
        with contextlib.ExitStack() as opened:
            try:
                made = _made(path, folder_mode)
            except (FileExistsError, FileNotFoundError):
                if not path.parent.is_dir():
                    raise
                continue  # somebody was quicker
            if made is not None:
                opened.callback(os.close, made)
                if lock(made) is False or not _has_name(made, path):
                    continue  # somebody who removes what is left over was between making and locking
            identity = os.lstat(path)
            try:
                yield path
            finally:
                with contextlib.suppress(OSError):
                    if os.path.samestat(identity, os.lstat(path)):
                        _remove(path)
            return


def _made(path: Path, folder_mode: int | None) -> int | None:
    """Makes a file or a folder that must not be there yet, open; None where an open one could not be renamed."""
    if folder_mode is None:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if _HAS_LOCKS:
            return file
        os.close(file)
        return None
    path.mkdir(folder_mode)
    return os.open(path, os.O_RDONLY) if _HAS_LOCKS else None


def _has_name(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.lstat(path))
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path in the folder of `path`, with its extension; renamed to `path` at the end, removed on failure.

    Where `path` is a symbolic link, all this holds for the file that it leads to. What a process that was killed left
    of the same file is removed first. Raises InputError where the folder cannot be written to, the disk is full, or
    `path` is a device or a pipe.
    """
    path = check_output_path(path)
    target = _target(path)
    try:
        with _temporary(target.with_name(path.name), path.suffix) as temporary:
            yield temporary
            os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error


def check_new_folder(path: str | Path) -> Path:
    """`path`, if there is nothing yet, or an empty folder; raises InputError before any long work is done."""
    path = checked_path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path} exists: remove it, or name another folder")
    return path


@contextlib.contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside `path`; renamed to it at the end, removed with all that is in it on failure.

    What a process that was killed left of it is removed first. Raises InputError where there is a folder that is not
    empty, or it cannot be written.
    """
    path = check_new_folder(path)
    make_folder(path.parent)
    try:
        with _temporary(path, folder_mode=0o777) as temporary:
            yield temporary
            if path.exists():
                path.rmdir()  # it is empty; Windows renames no folder to one that is there
            os.replace(temporary, path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error


@contextlib.contextmanager
def scratch_folder(beside: Path | None = None) -> Iterator[Path]:
    """An empty folder for what is on its way, gone at the end: beside a path, or in the system's temporary folder.

    What a process that was killed left of it is removed first. Raises InputError where it cannot be made.
    """
    target = Path(tempfile.gettempdir()) / "lightfield-gs" if beside is None else beside
    with contextlib.ExitStack() as made:
        try:
            folder = made.enter_context(_temporary(target, folder_mode=0o700))
        except OSError as error:
            raise InputError(f"cannot write in {target.parent}: {error.strerror or error}") from error
        yield folder


def sha256(*paths: str | Path) -> str:
    """Return the hexadecimal SHA-256 of the contents of files, one after the other; raise InputError."""
    digest = hashlib.sha256()
    for path in paths:
        with reading(path), open(path, "rb") as file:
            while chunk := file.read(_HASH_CHUNK_BYTES):
                digest.update(chunk)
    return digest.hexdigest()
