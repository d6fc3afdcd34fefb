"""Drawings of the CUDA stages compiled for the CPU, for the tests: their module, and processes that draw."""

from __future__ import annotations

import importlib.util
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch

HERE = Path(__file__).parent
CSRC = HERE.parents[1] / "csrc"
LACKING = (
    platform.machine() != "x86_64"
    or shutil.which("g++") is None
    or not Path("/usr/include/hwy").exists()
    or importlib.util.find_spec("pybind11") is None
)
# Of every file whose tests ask for what is drawn; its DRAWN names all of that, in their order
EMULATED = [
    pytest.mark.skipif(LACKING, reason="needs g++ on x86-64, pybind11, and the packages of GLM and Highway"),
    pytest.mark.cuda_emulated,
    pytest.mark.long_file,
    pytest.mark.not_sanitized,
]


def built_once(folder: Path) -> str:
    """The native module with emulated CUDA stages. The first process that asks makes it in the folder, while others
    wait."""
    import fcntl  # of Linux, as these tests

    import pybind11

    folder.mkdir(exist_ok=True)
    made = folder / "module"  # its path, once it is whole
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            command = [sys.executable, HERE / "build.py", CSRC, folder, pybind11.get_include()]
            made.write_text(subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip())
    return made.read_text()


class Drawer:
    """A draw.py that runs, and draws one thing after the other."""

    def __init__(self, module: str, folder: Path):
        command = [sys.executable, HERE / "draw.py", module, folder]
        self.folder = folder
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __call__(self, what: str) -> Any:
        print(what, file=self.process.stdin, flush=True)
        code = self.process.stdout.readline().strip()
        assert code == "0", f"{code}: {(self.folder / f'{what}.log').read_text()[-2000:]}"
        return torch.load(self.folder / f"{what}.pt", weights_only=True)

    def end(self) -> None:
        self.process.stdin.close()
        self.process.wait()


class Drawings:
    """The drawings of all cases, by two drawers.

    One draws all cases from the last to the first. Tests ask from the first on, and the other draws what has not begun.
    """

    def __init__(self, module: str, folder: Path, names: Sequence[str]):
        self.asked, self.ahead = (Drawer(module, folder) for _ in range(2))
        self.pool = ThreadPoolExecutor(1)
        self.begun = {what: self.pool.submit(self.ahead, what) for what in reversed(names)}

    def __call__(self, what: str) -> Any:
        return self.asked(what) if self.begun[what].cancel() else self.begun[what].result()

    def end(self) -> None:
        self.pool.shutdown(cancel_futures=True)
        self.asked.end(), self.ahead.end()
