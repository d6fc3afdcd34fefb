"""Files and folders that appear complete or not at all, checks of paths, locks and checksums."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from lightfield_gs.base import system
from lightfield_gs.base.checks import wrong_type
from lightfield_gs.base.errors import InputError, reading

# Names of temporary files: the stem, a number, the suffix; earlier versions had twelve digits for the number
_TEMPORARY = re.compile(r"\..*\.(partial-\d+|[0-9a-f]{12})(\.[^.]*)?", re.DOTALL)
_LOOKED_AT = 4  # numbers checked for files of killed processes; more if all of these are taken
_HASH_CHUNK_BYTES = 1 << 20
_GUARD = "~"  # begins the name of the file beside a temporary one that is locked in its stead


def checked_path(path: str | os.PathLike) -> Path:
    """Return `path` as a Path; raise InputError where it is none."""
    if not isinstance(path, (str, os.PathLike)):
        raise wrong_type("path", path, str, os.PathLike)
    try:
        bad = b"\0" in os.fsencode(path)
    except UnicodeEncodeError:
        bad = True
    if bad:
        raise InputError(f"path: expected a file name, got one that none can have, {ascii(os.fspath(path))[:80]}")
    return Path(path)


def check_output_path(path: str | Path) -> Path:
    """Return `path` if a file can be written there; raise InputError, before any long work is done in vain."""
    path = checked_path(path)
    system.check_name(path)
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
    """Return the file to write: the target of a symbolic link, which is kept."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def check_outputs(outputs: Iterable[str | Path | None], inputs: Iterable[str | Path | None] = ()) -> None:
    """Raise InputError if a command would overwrite its input, or one output by another.

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
    """Tell whether two paths name one file, also through links, and also if it is absent."""
    try:
        return os.path.samefile(one, other)
    except OSError:
        return os.path.realpath(one) == os.path.realpath(other)


def make_folder(path: str | Path) -> Path:
    """Make a folder and its parents where they are absent, and return its path; raise InputError where that fails."""
    path = checked_path(path)
    system.check_name(path)
    if os.path.exists(path) and not path.is_dir():
        raise InputError(f"cannot make the folder {path}: it is a file; give a folder")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot make the folder {path}: {error.strerror or error}") from error
    return path


def check_folder(path: str | Path) -> Path:
    """Return `path` if it is a writable folder, or can be made one; raise InputError, before any long work is done.

    The folder is made and removed again, since only trying tells: /proc takes no folders even from root.
    """
    path = checked_path(path)
    absent = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        make_folder(path)
        tempfile.TemporaryFile(dir=path).close()
    except OSError as error:
        raise InputError(f"cannot write in {path}: {error.strerror or error}") from error
    finally:
        with contextlib.suppress(OSError):  # not made, or in use by another process
            for folder in absent:
                folder.rmdir()
    return path


def remove_file(path: Path) -> None:
    """Remove a file if it exists; raise InputError where that fails."""
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"cannot remove {path}: {error.strerror or error}") from error


def remove_left_over(folder: Path) -> None:
    """Remove temporary files of killed processes in a folder and below; files being written stay."""
    for parent, folders, names in os.walk(folder):
        kept = (name.removeprefix(_GUARD) for name in [*folders, *names])
        for name in filter(_TEMPORARY.fullmatch, dict.fromkeys(kept)):
            remove_dead(Path(parent) / name)


def remove_dead(path: Path) -> None:
    """Remove a temporary file or folder if its process has ended, which frees its lock.

    It stays if the lock cannot be checked, or removal fails.
    """
    with contextlib.suppress(OSError), contextlib.ExitStack() as opened:
        if not system.renames_open_files():
            if opened.enter_context(_guard(path)):
                _remove(path)
            return
        try:
            file = os.open(path, os.O_RDWR | system.UNFOLLOWED)  # NFS locks only files opened for writing
        except IsADirectoryError:
            file = os.open(path, os.O_RDONLY | system.UNFOLLOWED)
        opened.callback(os.close, file)
        if system.lock(file) and os.path.samestat(os.fstat(file), os.lstat(path)):
            _remove(path)


@contextlib.contextmanager
def _guard(path: Path) -> Iterator[bool | None]:
    """Lock, in place of a temporary file, a file beside it for the time of the block.

    Temporary files are themselves locked where open files can be renamed. Yields what `system.lock` returns.
    """
    guard = path.with_name(_GUARD + path.name)
    file = os.open(guard, os.O_RDWR | os.O_CREAT | system.UNFOLLOWED, 0o666)
    is_ours = system.lock(file)
    try:
        yield is_ours
    finally:
        os.close(file)
        if is_ours is not False:
            with contextlib.suppress(OSError):  # another process has opened it
                guard.unlink()


def _remove(path: Path) -> None:
    """Remove a file, or a folder with its contents, as far as permissions allow."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


@contextlib.contextmanager
def _temporary(target: Path, suffix: str = "", folder_mode: int | None = None) -> Iterator[Path]:
    """Make an empty file beside `target`, or a folder with this mode, and lock it until the end of the context.

    It is removed at the end if it still has its name. Temporary files of killed processes for the same target are
    removed first.

    Raises:
        OSError: it cannot be made.
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
            if not system.renames_open_files() and opened.enter_context(_guard(path)) is False:
                continue
            try:
                made = _made(path, folder_mode)
            except (FileExistsError, FileNotFoundError):
                if not path.parent.is_dir():
                    raise
                continue  # another process was quicker
            if made is not None:
                opened.callback(os.close, made)
                if system.lock(made) is False or not _has_name(made, path):
                    continue  # another process removed it before it was locked
            identity = os.lstat(path)
            try:
                yield path
            finally:
                with contextlib.suppress(OSError):
                    if os.path.samestat(identity, os.lstat(path)):
                        _remove(path)
            return


def _made(path: Path, folder_mode: int | None) -> int | None:
    """Make and open a new file or folder; return None where an open one could not be renamed."""
    if folder_mode is None:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
        if system.renames_open_files():
            return file
        os.close(file)
        return None
    path.mkdir(folder_mode)
    return os.open(path, os.O_RDONLY) if system.renames_open_files() else None


def _has_name(file: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), os.lstat(path))
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`, which is renamed to `path` at the end and removed on failure.

    It has the extension of `path`. A symbolic link is followed. Temporary files of killed processes for the same target
    are removed first.

    Raises:
        InputError: the folder is not writable, the disk is full, or `path` is a device or a pipe.
    """
    path = check_output_path(path)
    target = _target(path)
    try:
        with _temporary(target.with_name(path.name), path.suffix) as temporary:
            yield temporary
            system.replace(temporary, target)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error


def check_new_folder(path: str | Path) -> Path:
    """Return `path` if it is absent or an empty folder; raise InputError, before any long work is done."""
    path = checked_path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise InputError(f"{path} exists: remove it, or name another folder")
    return path


@contextlib.contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, which is renamed to `path` at the end and removed on failure.

    Temporary folders of killed processes for the same target are removed first.

    Raises:
        InputError: there is a folder that is not empty, or it cannot be written.
    """
    path = check_new_folder(path)
    make_folder(path.parent)
    try:
        with _temporary(path, folder_mode=0o777) as temporary:
            yield temporary
            if path.exists():
                path.rmdir()  # empty; Windows does not rename to an existing folder
            system.replace(temporary, path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error


@contextlib.contextmanager
def scratch_folder(beside: Path | None = None) -> Iterator[Path]:
    """Yield an empty folder for temporary files, removed at the end.

    Args:
        beside: path beside which it is made; None for the system's temporary folder. Folders of killed processes for
            the same path are removed first.

    Raises:
        InputError: it cannot be made.
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
