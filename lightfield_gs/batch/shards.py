"""The processes of a batch on one machine: where they work, and their start anew when they die."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, NoReturn

from lightfield_gs.base.cli_messages import EXIT_INTERRUPTED, report_error
from lightfield_gs.base.device import choose_device, cores
from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.run import EXIT_BROKEN, Worker

_CORES_A_PROCESS = 4  # without a GPU: more cores draw one image faster, and fewer images in all
_MOST_WRITERS, _MOST_READERS = 32, 8
# Processes of a GPU: the threads of one process of Python take turns. With more than four processes, or fewer cores for
# each, an H100 makes no more images. For a photo at 7680 x 3840 each takes 1.5 GB of the GPU.
_CORES_BESIDE_A_GPU, _MOST_ON_A_GPU = 4, 4
_GPU_BYTES_A_PROCESS = 2 << 30
_PATIENCE_S = 5.0  # for a process to note its unfinished items

Shard = tuple[int, int]  # number, counted from 1, and how many there are


def choose_workers(
    devices: str | None, processes: int | None, threads: int | None, have_gpus: bool = False
) -> list[Worker]:
    """Return the workers of the processes on this machine.

    Args:
        devices: "cpu", or GPUs such as "cuda:0,cuda:1"; None: all GPUs, or the CPU without one.
        processes: their number; None: one to four a GPU by its memory and cores, or one for every four cores.
        threads: that draw in each process on the CPU; None: one a core of its fraction.
        have_gpus: whether a process needs a GPU for itself, as a fit does.

    Raises:
        InputError: a device is not there.
    """
    gpus, own = _gpus(devices), len(cores())
    if not gpus:
        count = processes or max(1, own // _CORES_A_PROCESS)
        each = threads or max(1, own // count)
        return [Worker(f"cpu:{n}", "cpu", None, each, 1, max(1, each // 2)) for n in range(count)]
    count = processes or len(gpus) * processes_per_gpu(own // len(gpus), have_gpus, _least_memory(gpus))
    each = max(1, own // count)
    return [
        Worker(
            f"cuda:{gpus[n % len(gpus)]}" + (f" process {n // len(gpus)}" if count > len(gpus) else ""),
            "cuda",
            _visible_name(gpus[n % len(gpus)]),
            threads or each,
            min(_MOST_READERS, max(2, each // 2)),
            min(_MOST_WRITERS, max(2, each)),
        )
        for n in range(count)
    ]


def processes_per_gpu(cores: int, have_gpus: bool, memory_bytes: int) -> int:
    """Return the number of processes for a GPU of `memory_bytes` with `cores` beside it."""
    fitting = min(_MOST_ON_A_GPU, cores // _CORES_BESIDE_A_GPU, memory_bytes // _GPU_BYTES_A_PROCESS)
    return 1 if have_gpus else max(1, fitting)


def _gpus(devices: str | None) -> list[int]:
    """Return the indices of the GPUs among the visible GPUs; [] for the CPU. Raises InputError."""
    if devices == "cpu" or devices is None and choose_device("auto") == "cpu":
        return []
    import torch

    if devices is None:
        return list(range(torch.cuda.device_count()))
    numbers = [re.fullmatch(r"cuda:(\d{1,3})", word) for word in devices.split(",")]
    if not all(numbers):
        raise InputError(f"--devices: expected cpu, or GPUs such as cuda:0,cuda:1, got {devices!r}")
    choose_device("cuda")
    found = [int(number[1]) for number in numbers if number is not None]
    count = torch.cuda.device_count()
    if max(found) >= count or len(set(found)) < len(found):
        raise InputError(f"--devices: expected different ones of cuda:0 to cuda:{count - 1}, got {devices}")
    return found


def _least_memory(gpus: list[int]) -> int:
    import torch

    return min(torch.cuda.get_device_properties(gpu).total_memory for gpu in gpus)


def _visible_name(gpu: int) -> str:
    """Return CUDA_VISIBLE_DEVICES for a process that sees one of the visible GPUs alone."""
    seen = [word.strip() for word in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if word.strip()]
    return seen[gpu] if gpu < len(seen) else str(gpu)


def run_shards(call: Callable[[Any, Shard, Worker], int], options: Any, workers: list[Worker], folder: Path) -> int:
    """Run `call(options, shard, worker)` in a process for each worker, and return the highest exit code.

    A process that dies is restarted as long as the manifests in `folder` grow. It begins with its unfinished items, one
    at a time, and leaves out items that killed it twice.
    """
    context = multiprocessing.get_context("spawn")  # a fork would share a device that is in use
    running: dict[int, tuple[SpawnProcess, int]] = {}
    codes = [0]

    def begin(number: int) -> None:
        shard = number + 1, len(workers)
        process = context.Process(target=_run, args=(call, options, shard, workers[number]), name=workers[number].name)
        with _environment("CUDA_VISIBLE_DEVICES", workers[number].visible):
            process.start()
        running[process.sentinel] = process, number

    def size() -> int:
        return sum(path.stat().st_size for path in folder.glob("batch*.jsonl"))

    sizes: dict[int, int] = {}
    try:
        for number in range(len(workers)):
            begin(number)
        while running:
            for sentinel in wait(list(running)):
                process, number = running.pop(int(str(sentinel)))
                process.join()
                code = process.exitcode or 0
                if (code < 0 or code == EXIT_BROKEN) and sizes.get(number) != (now := size()):
                    sizes[number] = now
                    begin(number)
                else:
                    codes.append(code if code >= 0 else 128 - code)
    finally:
        for process, _ in running.values():
            process.terminate()
        for process, _ in running.values():
            process.join(_PATIENCE_S)
            process.kill()
            process.join()
    return max(codes)


def _run(call: Callable[[Any, Shard, Worker], int], options: Any, shard: Shard, worker: Worker) -> None:
    """Be a process of a batch: it ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this process
    signal.signal(signal.SIGTERM, _stop)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        sys.exit(call(options, shard, worker))
    except (InputError, OSError) as error:
        sys.exit(report_error("lightfield-gs", error, ""))
    except KeyboardInterrupt:
        os._exit(EXIT_INTERRUPTED)  # without waiting for threads that are at work


def _stop(number: int, frame: object) -> NoReturn:
    raise KeyboardInterrupt


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


@contextmanager
def _environment(name: str, value: str | None) -> Iterator[None]:
    """Set an environment variable for the processes that start meanwhile; None leaves it."""
    before = os.environ.get(name)
    if value is not None:
        os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = before
