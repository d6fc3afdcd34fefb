"""What the package does where the system is Windows, by a stand-in: the package is not run there."""

import ctypes
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import windows

from lightfield_gs import InputError
from lightfield_gs.base import system
from lightfield_gs.batch.items import read_items
from lightfield_gs.batch.shards import choose_workers
from lightfield_gs.io.atomic import atomic_path, check_output_path, make_folder

EVERY_MODULE = """
import contextlib, importlib, pkgutil
import numpy, OpenImageIO, PIL.Image, scipy.ndimage, torch, torch.distributed  # what is not ours may ask for them
for name in ("av", "cv2", "wgpu"):
    with contextlib.suppress(ImportError):
        importlib.import_module(name)
windows.stand_in(pytest.MonkeyPatch())
import lightfield_gs
names = [module.name for module in pkgutil.walk_packages(lightfield_gs.__path__, "lightfield_gs.")]
for name in names:
    importlib.import_module(name)
print(len(names))
"""


def test_every_module_is_imported_without_what_windows_lacks():
    done = subprocess.run([sys.executable, "-c", windows.HERE + EVERY_MODULE], capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) > 200, done.stderr


def test_names_that_no_file_of_windows_has_are_refused(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(system, "IS_WINDOWS", True)
    for name in ("in/a:b.png", "what?.png", "NUL.png", "com1", "aux.tar.gz", "a/con/b.png", "end.", "end ", "a\tb.png"):
        with pytest.raises(InputError, match="Windows has no file named"):
            check_output_path(name)
        with pytest.raises(InputError, match="Windows has no file named"):
            make_folder(name)
    for name in ("nulls.png", "../x.png", "C:\\photos\\a.png", "com10.png", ".hidden.png", "\u5149.png"):
        system.check_name(Path(name))
    monkeypatch.setattr(system, "IS_WINDOWS", False)
    check_output_path("what?.png")


def test_backslashes_are_of_paths(monkeypatch, tmp_path):
    photo = tmp_path / "a.png"
    photo.write_bytes(b"")
    entry = {"input": str(photo), "command": "fit", "fit_options": '--masks C:\\in\\m --test-list "a b"'}
    (tmp_path / "list").write_text(json.dumps(entry))
    monkeypatch.setattr(system, "IS_WINDOWS", True)
    (item,), _ = read_items(tmp_path / "list", ".png", tmp_path / "out")
    assert item.fit_words == ("--masks", "C:\\in\\m", "--test-list", "a b")
    assert system.quoted("show", "C:\\my photos\\a.png") == 'show "C:\\my photos\\a.png"'


def test_a_file_that_a_scanner_looks_into_is_written_when_it_is_done(monkeypatch, tmp_path):
    target, tries, rename = tmp_path / "a.txt", [], os.replace

    def replace(source, target):
        tries.append(source)
        if len(tries) < 3:
            raise PermissionError(13, "Access is denied")
        rename(source, target)

    monkeypatch.setattr(system, "IS_WINDOWS", True)
    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setitem(sys.modules, "msvcrt", windows.msvcrt())
    with atomic_path(target) as temporary:
        temporary.write_text("new")
    assert len(tries) == 3 and [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_what_windows_tells_of_memory_ends_and_processes(monkeypatch):
    class Kernel:
        @staticmethod
        def GlobalMemoryStatusEx(status):
            told = status._obj
            told.ullAvailPhys = 5 << 30
            return told.dwLength == 64

    monkeypatch.setattr(system, "IS_WINDOWS", True)
    monkeypatch.setattr(ctypes, "windll", type("Libraries", (), {"kernel32": Kernel}), raising=False)
    assert system.free_host_memory() == 5 << 30
    monkeypatch.setattr(signal, "SIGBREAK", signal.SIGUSR1, raising=False)
    assert system.stop_signals() == (signal.SIGTERM, signal.SIGUSR1)
    assert system.is_crash(0xC0000005) and system.is_crash(-9) and not system.is_crash(2)
    assert system.is_closed_pipe(OSError(22, "Invalid argument")) and not system.is_closed_pipe(OSError(28, "full"))
    with pytest.raises(InputError, match="this system waits for 60"):
        choose_workers("cpu", 61, None)


def test_names_that_a_console_cannot_show_are_printed_as_escapes(tmp_path):
    for name in ("\u5149", "\u5f71"):  # one for each process
        (tmp_path / f"{name}.png").write_bytes(b"no picture")
    line = [sys.executable, "-m", "lightfield_gs", "batch", ".", "-o", "\u5149", "--devices", "cpu", "--processes", "2"]
    done = subprocess.run(
        line, capture_output=True, cwd=tmp_path, env=os.environ | {"PYTHONIOENCODING": "cp1252", "PYTHONUTF8": "0"}
    )
    assert done.returncode == 1 and b"UnicodeEncodeError" not in done.stderr, done.stderr
    assert b"\\u5149: 0 of 1 items are done" in done.stdout
    assert b"failed: \\u5149.png: " in done.stderr and b"failed: \\u5f71.png: " in done.stderr
