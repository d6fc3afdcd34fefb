"""The places of a batch's processes: one a GPU, or one a few cores."""

from __future__ import annotations

import os
import re

from lightfield_gs.base.device import choose_device, cores
from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.worker import Place

CORES_A_PROCESS = 4  # of a CPU: more draw one image faster, and fewer images in all
_MOST_WRITERS, _MOST_READERS = 32, 8
# More than one, for the threads of one process of Python take turns; with more than four, or fewer cores for each, an
# H100 makes no more images. For a photo at 7680 x 3840 each takes 1.5 GB of the GPU.
_CORES_BESIDE_A_GPU, _MOST_ON_A_GPU = 4, 4
_GPU_BYTES_A_PROCESS = 2 << 30


def places_here(
    devices: str | None, processes: int | None, threads: int | None, have_gpus: bool = False
) -> list[Place]:
    """The places on this machine.

    devices: "cpu", or "cuda:0,cuda:1"; None: all GPUs that are seen, or the CPU where there is none that can be used.
    processes: how many, which take turns on the devices; None: one to four a GPU, one for every four of its share of
    the cores and every 2 GiB of its memory, or without a GPU one for every CORES_A_PROCESS.
    have_gpus: whether each process is to have a GPU for itself, as for fits, where nothing else is said.
    threads: that draw in each on the CPU (None: one a core of its own). Raises InputError.
    """
    gpus = _gpus(devices)
    own = cores()
    if not gpus:
        count = processes or max(1, len(own) // CORES_A_PROCESS)
        return [_on_cpu(number, own[number::count] or own, threads) for number in range(count)]
    count = processes or len(gpus) * on_a_gpu(len(own) // len(gpus), have_gpus, _least_memory(gpus))
    names = [gpus[number % len(gpus)] for number in range(count)]
    share = max(1, len(own) // count)
    return [
        Place(
            f"cuda:{gpu}" + (f" process {number // len(gpus)}" if count > len(gpus) else ""),
            "cuda",
            _visible(gpu),
            (),
            threads or share,
            *threads_beside(share),
        )
        for number, gpu in enumerate(names)
    ]


def on_a_gpu(cores: int, have_gpus: bool, memory_bytes: int | None = None) -> int:
    """Processes on a GPU that has so many cores, and so much memory where that is known; have_gpus: see places_here."""
    room = _MOST_ON_A_GPU if memory_bytes is None else memory_bytes // _GPU_BYTES_A_PROCESS
    return 1 if have_gpus else max(1, min(_MOST_ON_A_GPU, cores // _CORES_BESIDE_A_GPU, room))


def threads_beside(share: int) -> tuple[int, int]:
    """Threads that read and that write beside a GPU, of a process that has so many cores."""
    return min(_MOST_READERS, max(2, share // 2)), min(_MOST_WRITERS, max(2, share))


def on_cpu(name: str, own: tuple[int, ...], threads: int) -> Place:
    """A process that draws on the CPU, where reading and writing take from the drawing."""
    return Place(name, "cpu", cores=own, threads=threads, readers=1, writers=max(1, threads // 2))


def _on_cpu(number: int, own: list[int], threads: int | None) -> Place:
    return on_cpu(f"cpu:{number}", tuple(own), threads or len(own))


def _gpus(devices: str | None) -> list[int]:
    """Numbers of the GPUs, of those that are seen; [] for the CPU. Raises InputError."""
    if devices is None:
        if choose_device("auto") == "cpu":
            return []
        import torch

        return list(range(torch.cuda.device_count()))
    if devices == "cpu":
        return []
    numbers = [re.fullmatch(r"cuda:(\d{1,3})", word) for word in devices.split(",")]
    if not all(numbers):
        raise InputError(f"--devices: expected cpu, or GPUs such as cuda:0,cuda:1, got {devices!r}")
    choose_device("cuda")
    import torch

    found = [int(number[1]) for number in numbers if number is not None]
    count = torch.cuda.device_count()
    if max(found) >= count or len(set(found)) < len(found):
        raise InputError(f"--devices: expected different ones of cuda:0 to cuda:{count - 1}, got {devices}")
    return found


def _least_memory(gpus: list[int]) -> int:
    """Bytes of the GPU that has the least."""
    import torch

    return min(torch.cuda.get_device_properties(gpu).total_memory for gpu in gpus)


def _visible(gpu: int) -> str:
    """What CUDA_VISIBLE_DEVICES says for a process that is to see this one alone, of those that are seen here."""
    seen = [word.strip() for word in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if word.strip()]
    return seen[gpu] if seen else str(gpu)
