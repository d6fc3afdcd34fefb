"""What systems do differently: locks, files in use, names of files, signals, command lines, processors and memory.

Windows lacks fcntl, /proc, most signals and the renaming of open files; macOS lacks /proc. No other file of the package
asks which system it is, but those of displays, whose screens each system lists in its own way.
"""

from __future__ import annotations

import ctypes
import errno
import importlib
import os
import platform
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path, PurePath, PureWindowsPath
from typing import Any

from lightfield_gs.base.errors import InputError

IS_WINDOWS = sys.platform == "win32"
# Of os.open: bytes as they are (Windows), links not followed, no wait for the other end of a pipe (Linux, macOS)
BYTES, UNFOLLOWED = getattr(os, "O_BINARY", 0), getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
# A lock of Windows keeps other processes from reading the bytes, so that it is of a byte that no file here reaches
_LOCKED_BYTE = (1 << 31) - 2
_PATIENCE_S = 2.0  # for programs that look into each new file, as scanners of viruses do
_CRASHED = 0xC0000000  # exit codes of Windows from here on are of crashes, as 0xC0000005 of memory that is not there
_WAITABLE = 60  # processes that Windows waits for at once, less some
_SIGNS = '<>:"|?*'
_DEVICES = frozenset(
    ("con", "prn", "aux", "nul", *(f"{name}{digit}" for name in ("com", "lpt") for digit in range(1, 10)))
)


def lock(file: int) -> bool | None:
    """Lock an open file, on Linux and macOS also an open folder, for as long as it is open in this process.

    Args:
        file: its number, of os.open.

    Returns:
        False if another process holds the lock; None without locks, as in some file systems.
    """
    try:
        if IS_WINDOWS:
            own = importlib.import_module("msvcrt")
            at = os.lseek(file, 0, os.SEEK_CUR)
            os.lseek(file, _LOCKED_BYTE, os.SEEK_SET)
            try:
                own.locking(file, own.LK_NBLCK, 1)
            finally:
                os.lseek(file, at, os.SEEK_SET)
        else:
            own = importlib.import_module("fcntl")
            own.flock(file, own.LOCK_EX | own.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True


def renames_open_files() -> bool:
    """Return whether files that are open can be renamed and removed; on Windows they cannot."""
    return not IS_WINDOWS


def replace(source: str | Path, target: str | Path) -> None:
    """Rename a file or a folder, over another file where there is one.

    On Windows another program may have either open for a moment: it is tried for two seconds.
    """
    deadline = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return os.replace(source, target)
        except PermissionError:
            if renames_open_files() or time.monotonic() >= deadline:
                raise
            time.sleep(0.05)


def check_name(path: PurePath) -> None:
    """Raise InputError where no file of this system can have a name: Windows writes `NUL.png` to nowhere, silently."""
    if not IS_WINDOWS:
        return
    path = PureWindowsPath(str(path))
    for part in path.parts[1 if path.anchor else 0 :]:
        is_device = part.split(".")[0].rstrip(" ").lower() in _DEVICES
        has_sign = any(sign in _SIGNS or sign < " " for sign in part)
        if is_device or has_sign or part != ".." and part[-1:] in ". ":
            raise InputError(
                f"cannot write {path}: Windows has no file named {part!r}; avoid {' '.join(_SIGNS)}, spaces and dots "
                "at the end, and names of devices such as CON, NUL and COM1"
            )


def split_words(text: str) -> list[str]:
    r"""Return the words of a command line; on Windows a backslash is a part of a path, elsewhere it quotes.

    Raises:
        ValueError: a quotation mark is left open.
    """
    words = shlex.shlex(text, posix=True, punctuation_chars=False)
    words.whitespace_split, words.commenters = True, ""
    if IS_WINDOWS:
        words.escape = ""
    return list(words)


def quoted(*words: object) -> str:
    """Return words as a command line that a terminal reads as them."""
    texts = [str(word) for word in words]
    return subprocess.list2cmdline(texts) if IS_WINDOWS else shlex.join(texts)


def stop_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that ask a program to end, other than Ctrl-C: SIGTERM, and on Windows Ctrl-Break."""
    return tuple(signal.Signals(number) for name in ("SIGTERM", "SIGBREAK") if (number := getattr(signal, name, None)))


def is_crash(exit_code: int) -> bool:
    """Return whether a process with this exit code, of multiprocessing, did not end by itself."""
    return exit_code < 0 or exit_code >= _CRASHED


def most_processes() -> int | None:
    """Return the number of processes that one can wait for; None: any."""
    return _WAITABLE if IS_WINDOWS else None


def is_closed_pipe(error: OSError) -> bool:
    """Return whether a write failed since nobody reads any more; Windows says "invalid argument"."""
    return isinstance(error, BrokenPipeError) or IS_WINDOWS and error.errno == errno.EINVAL


def cores() -> list[int]:
    """Return the cores that this process may use; macOS and Windows do not tell: all cores of the machine there."""
    tell = getattr(os, "sched_getaffinity", None)
    return list(range(os.cpu_count() or 1)) if tell is None else sorted(tell(0))


def processor() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def free_host_memory() -> int | None:
    """Return the free bytes of memory; on macOS, which does not tell, all bytes; None where nothing is told."""
    if IS_WINDOWS:
        return _free_windows_memory()
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            lines = dict(line.split(":", 1) for line in file)
        return int(lines["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        pass
    tell: Any = getattr(os, "sysconf", None)
    try:
        return None if tell is None else tell("SC_PHYS_PAGES") * tell("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None


class MemoryStatus(ctypes.Structure):
    """MEMORYSTATUSEX of sysinfoapi.h."""

    _fields_ = (
        ("dwLength", ctypes.c_uint32),
        ("dwMemoryLoad", ctypes.c_uint32),
        ("ullTotalPhys", ctypes.c_uint64),
        ("ullAvailPhys", ctypes.c_uint64),
        ("rest", ctypes.c_uint64 * 5),
    )


def _free_windows_memory() -> int | None:
    libraries: Any = ctypes
    status = MemoryStatus(dwLength=ctypes.sizeof(MemoryStatus))
    return status.ullAvailPhys if libraries.windll.kernel32.GlobalMemoryStatusEx(ctypes.byref(status)) else None


def cache_folder() -> Path:
    """Return the folder of this program in the user's cache; it may be absent."""
    if IS_WINDOWS:
        base = os.environ.get("LOCALAPPDATA") or str(Path.home() / "AppData" / "Local")
    else:
        base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "lightfield-gs"


def settings_folder() -> Path:
    """Return the folder of this program's settings, which the user keeps; it may be absent."""
    if IS_WINDOWS:
        base = os.environ.get("APPDATA") or str(Path.home() / "AppData" / "Roaming")
    else:
        base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(base) / "lightfield-gs"
