"""A stand-in for Windows on Linux, for tests that undo it and for programs of tests.

Files that any process has open are not renamed or removed, locks are of bytes, and what Python lacks there is absent.
"""

import contextlib
import os
import struct
import sys
import types
from pathlib import Path

LACKING = ("fcntl", "grp", "pwd", "resource", "termios")  # modules
LACKING_OS = ("O_NOFOLLOW", "O_NONBLOCK", "fork", "getuid", "killpg", "sched_getaffinity", "sysconf")


def msvcrt() -> types.ModuleType:
    """The module of that name: its locks are those of an open file, so that other numbers of it are refused."""
    import fcntl

    def locking(file: int, mode: int, size: int) -> None:
        # struct flock of Linux: kind, from where, first byte, bytes, process
        wanted = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, os.lseek(file, 0, os.SEEK_CUR), size, 0)
        try:
            fcntl.fcntl(file, fcntl.F_OFD_SETLK, wanted)
        except OSError as error:
            raise PermissionError(13, "Permission denied") from error

    module = types.ModuleType("msvcrt")
    module.locking, module.LK_NBLCK = locking, 2
    return module


def is_open(path) -> bool:
    """Whether any process has a file, or one below a folder, open, or this process has it in memory (mmap)."""
    names = [line.split(maxsplit=5)[5].rstrip("\n") for line in open("/proc/self/maps") if "/" in line]
    for process in filter(str.isdecimal, os.listdir("/proc")):
        with contextlib.suppress(OSError):  # it may end meanwhile, or be another user's
            for file in os.listdir(f"/proc/{process}/fd"):
                with contextlib.suppress(OSError):
                    names.append(os.readlink(f"/proc/{process}/fd/{file}"))
    held = os.path.realpath(path)
    return any(name == held or name.startswith(f"{held}/") for name in names)


def refusing(call):
    """A call of `os` that refuses its paths where they are open."""

    def refuse(*paths, **options):
        if not options and any(map(is_open, paths)):
            raise PermissionError(13, "The process cannot access the file because it is being used by another process")
        return call(*paths, **options)

    return refuse


def stand_in(patch) -> None:
    """Turns this process into one of Windows, as far as the package sees; `patch` is pytest's monkeypatch."""
    from lightfield_gs.base import system

    patch.setattr(system, "IS_WINDOWS", True)
    patch.setattr(system, "UNFOLLOWED", 0)
    patch.setitem(sys.modules, "msvcrt", msvcrt())
    for name in ("replace", "unlink", "rmdir"):
        patch.setattr(os, name, refusing(getattr(os, name)))
    for name in LACKING:
        patch.setitem(sys.modules, name, None)
    for name in LACKING_OS:
        patch.delattr(os, name)


HERE = f"import sys, pytest; sys.path.insert(0, {str(Path(__file__).parent)!r}); import windows; "
PRELUDE = HERE + "windows.stand_in(pytest.MonkeyPatch())\n"  # of a program
