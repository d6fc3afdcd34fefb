"""Commands of this package side by side, each on a GPU of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import make_folder

_PAUSE = 0.2  # seconds between looks at the processes


class _Told(BaseException):
    """This process was told to end."""


def run_side_by_side(commands: dict[str, list[str]], logs: dict[str, Path], devices: int) -> bool:
    """Run `python -m training.compare` once for each name, and wait. A signal ends all of them as it would end one.

    Args:
        commands: The arguments of each.
        logs: The file that each appends its output to.
        devices: How many run at once. Each sees one GPU of CUDA_VISIBLE_DEVICES, or of all.

    Returns:
        Whether all of them ended by themselves.

    Raises:
        InputError: one of them failed; the others were not cut off.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
    free = visible[:devices] if len(visible) >= devices else [str(number) for number in range(devices)]
    waiting, failed = list(commands), []
    running: dict[str, tuple[str, subprocess.Popen]] = {}
    with _signals_raised():
        try:
            while waiting or running:
                while waiting and free:
                    name, device = waiting.pop(0), free.pop(0)
                    running[name] = (device, _started(commands[name], logs[name], device))
                    print(f"{name}: on device {device}, output in {logs[name]}", flush=True)
                time.sleep(_PAUSE)
                for name in [name for name, (_, process) in running.items() if process.poll() is not None]:
                    device, process = running.pop(name)
                    free.append(device)
                    if process.returncode:
                        failed.append(name)
        except _Told:
            for _, process in running.values():
                process.send_signal(signal.SIGTERM)
            return False
        finally:
            for _, process in running.values():
                process.wait()
    if failed:
        lines = logs[failed[0]].read_text(errors="replace").split()
        raise InputError(f"{', '.join(failed)}: failed; {logs[failed[0]]} ends with: {' '.join(lines[-40:])}")
    return True


def _started(arguments: list[str], log: Path, device: str) -> subprocess.Popen:
    make_folder(log.parent)
    with open(log, "ab") as file:
        return subprocess.Popen(
            [sys.executable, "-m", "training.compare", *arguments],
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"CUDA_VISIBLE_DEVICES": device},
            start_new_session=True,  # the terminal's interrupt comes through this process alone
        )


@contextmanager
def _signals_raised() -> Iterator[None]:
    """Raise _Told at SIGTERM and SIGINT."""

    def tell(*_: object) -> None:
        raise _Told

    former = {number: signal.signal(number, tell) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
