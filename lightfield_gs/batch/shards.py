"""The processes of a batch on one machine: their resources, and their restart when they die."""

from __future__ import annotations

import _thread
import multiprocessing
import os
import re
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

from lightfield_gs.base import system
from lightfield_gs.base.cli_messages import EXIT_INTERRUPTED, print_any_name, report_error
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.run import EXIT_BROKEN, Worker

_CORES_A_PROCESS = 4  # without a GPU: more cores draw one image faster, and fewer images in all
_MOST_WRITERS, _MOST_READERS = 32, 8
# Processes of a GPU: the threads of one process of Python take turns. With more than four processes, or fewer cores for
# each, an H100 makes no more images. For a photo at 7680 x 3840 each takes 1.5 GB of the GPU.
_CORES_BESIDE_A_GPU, _MOST_ON_A_GPU = 4, 4
_GPU_BYTES_A_PROCESS = 2 << 30
_PATIENCE_S = 5.0  # for a process to note the items in progress

Shard = tuple[int, int]  # number, counted from 1, and how many there are


def choose_workers(
    devices: str | None, processes: int | None, threads: int | None, have_gpus: bool = False
) -> list[Worker]:
    """Return the workers of the processes on this machine.

    Args:
        devices: "cpu", or GPUs such as "cuda:0,cuda:1"; None: all GPUs, or the CPU without one.
        processes: their number; None: one to four a GPU by its memory and cores, or one for every four cores.
        threads: threads that draw in each process on the CPU; None: one for each of its cores.
        have_gpus: whether a process needs a GPU for itself, as a fit does.

    Raises:
        InputError: a device is not there, or there are more processes than the system can wait for.
    """
    most = system.most_processes()
    if most is not None and processes is not None and processes > most:
        raise InputError(f"processes={processes}: this system waits for {most} at most; use fewer, or shards")
    gpus, own = _list_gpus(devices), len(system.cores())
    if not gpus:
        count = processes or max(1, min(own // _CORES_A_PROCESS, most or own))
        each = threads or max(1, own // count)
        return [Worker(f"cpu:{n}", "cpu", None, each, 1, max(1, each // 2)) for n in range(count)]
    count = processes or len(gpus) * processes_per_gpu(own // len(gpus), have_gpus, _least_memory(gpus))
    each = max(1, own // count)
    readers, writers = min(_MOST_READERS, max(2, each // 2)), min(_MOST_WRITERS, max(2, each))
    seen = [word.strip() for word in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if word.strip()]
    workers = []
    for n in range(count):
        gpu = gpus[n % len(gpus)]
        name = f"cuda:{gpu}" + (f" process {n // len(gpus)}" if count > len(gpus) else "")
        visible = seen[gpu] if gpu < len(seen) else str(gpu)
        workers.append(Worker(name, "cuda", visible, threads or each, readers, writers))
    return workers


def processes_per_gpu(cores: int, have_gpus: bool, memory_bytes: int) -> int:
    """Return the number of processes for a GPU of `memory_bytes` with `cores` beside it."""
    fitting = min(_MOST_ON_A_GPU, cores // _CORES_BESIDE_A_GPU, memory_bytes // _GPU_BYTES_A_PROCESS)
    return 1 if have_gpus else max(1, fitting)


def _list_gpus(devices: str | None) -> list[int]:
    """Return the numbers of the GPUs among those that are visible; [] for the CPU. Raises InputError."""
    if devices == "cpu" or devices is None and choose_device("auto") == "cpu":
        return []
    import torch

    if devices is None:
        return list(range(torch.cuda.device_count()))
    if not re.fullmatch(r"cuda:\d{1,3}(,cuda:\d{1,3})*", devices):
        raise InputError(f"devices=: expected cpu, or GPUs such as cuda:0,cuda:1, got {devices!r}")
    choose_device("cuda")
    found, count = [int(word[5:]) for word in devices.split(",")], torch.cuda.device_count()
    if max(found) >= count or len(set(found)) < len(found):
        raise InputError(f"devices=: expected different ones of cuda:0 to cuda:{count - 1}, got {devices}")
    return found


def _least_memory(gpus: list[int]) -> int:
    import torch

    return min(torch.cuda.get_device_properties(gpu).total_memory for gpu in gpus)


def run_shards(call: Callable[[Any, Shard, Worker], int], options: Any, workers: list[Worker], folder: Path) -> int:
    """Run `call(options, shard, worker)` in a process for each worker, and return the highest exit code.

    A process that dies is restarted as long as the manifests in `folder` grow. It begins with its unfinished items, one
    at a time, and leaves out items that killed it twice.
    """
    context = multiprocessing.get_context("spawn")  # a fork would share a device that is in use
    # By sentinel: process, the Connection of orders to it, number, bytes of the manifests when it began
    running: dict[Any, tuple[SpawnProcess, Any, int, int]] = {}
    codes = [0]

    def start(number: int, size: int) -> None:
        orders, ours = context.Pipe(duplex=False)
        arguments = call, options, (number + 1, len(workers)), workers[number], orders
        process = context.Process(target=_run_shard, args=arguments, name=workers[number].name)
        process.start()
        orders.close()
        running[process.sentinel] = process, ours, number, size

    try:
        for number in range(len(workers)):
            start(number, -1)
        while running:
            for sentinel in wait(list(running)):
                process, _, number, before = running.pop(sentinel)
                process.join()
                code, size = process.exitcode or 0, sum(path.stat().st_size for path in folder.glob("batch*.jsonl"))
                if (system.is_crash(code) or code == EXIT_BROKEN) and size != before:
                    start(number, size)
                else:
                    codes.append(code if code >= 0 else 128 - code)
    finally:
        for _, ours, _, _ in running.values():
            with suppress(OSError):  # it has just ended
                ours.send(None)
        for process, _, _, _ in running.values():
            process.join(_PATIENCE_S)
            process.kill()
            process.join()
    return max(codes)


def _run_shard(
    call: Callable[[Any, Shard, Worker], int], options: Any, shard: Shard, worker: Worker, orders: Connection
) -> None:
    """Run a shard in this process, which ends with its parent, or when something comes through `orders`."""
    if worker.visible is not None:
        os.environ["CUDA_VISIBLE_DEVICES"] = worker.visible  # in time: nothing has asked for a GPU in this process
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this process
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    print_any_name()
    threading.Thread(target=_obey, args=(orders,), daemon=True).start()
    try:
        sys.exit(call(options, shard, worker))
    except (InputError, OSError) as error:
        sys.exit(report_error("lightfield-gs", error, ""))
    except KeyboardInterrupt:
        os._exit(EXIT_INTERRUPTED)  # without waiting for threads that are at work


def _obey(orders: Connection) -> None:
    """Interrupt this process when its parent says so, and end it when the parent has ended.

    The parent sends no signal: one that Windows sends ends a process before it can note its items in progress.
    """
    with suppress(EOFError, OSError):
        orders.recv()
        _thread.interrupt_main(signal.SIGTERM)
        orders.recv()
    os._exit(1)
