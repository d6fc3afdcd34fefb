"""The clock of the benchmarks, and the machine that it ran on."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from lightfield_gs import build_info

SECONDS_PER_CALL = 60.0  # no further run once all of them have taken so long
SHORT_MS = 50.0  # on CUDA what takes less is repeated more often: one hiccup moves its median further
REPEATS, SHORT_REPEATS = 5, 20
WARM_UP = 2  # calls on CUDA that do not count: kernels load, the allocator fills, a graph is captured


def timed(call: Callable[[], Any], cuda: bool, repeats: int | None = None) -> tuple[Any, list[float]]:
    """The last result of a call, and the times of the runs in ms, in their order.

    On CUDA: warm runs, each between two events on the current stream. repeats None: 20 runs of what takes less than
    50 ms on CUDA, 5 of all else. At least one run, and none begins after a minute.
    """
    clock = _cuda_ms if cuda else _wall_ms
    took = 0.0
    for _ in range(WARM_UP if cuda else 0):
        result, took = clock(call)
    if repeats is None:
        repeats = SHORT_REPEATS if cuda and took < SHORT_MS else REPEATS
    times: list[float] = []
    while len(times) < repeats and (not times or sum(times) < 1e3 * SECONDS_PER_CALL):
        result, took = clock(call)
        times.append(took)
    return result, times


def median_ms(call: Callable[[], Any], cuda: bool, repeats: int | None = None) -> float:
    """The median of the runs of `timed`, in ms."""
    return statistics.median(timed(call, cuda, repeats)[1])


def _wall_ms(call: Callable[[], Any]) -> tuple[Any, float]:
    begin = time.perf_counter()
    result = call()
    return result, 1e3 * (time.perf_counter() - begin)


def _cuda_ms(call: Callable[[], Any]) -> tuple[Any, float]:
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    result = call()
    end.record()
    end.synchronize()
    return result, start.elapsed_time(end)


def machine(device: str) -> dict[str, Any]:
    """What the times depend on besides the program: processor, cores, GPU, versions."""
    found: dict[str, Any] = {"processor": _processor(), "cores": len(os.sched_getaffinity(0)),
                             "system": platform.platform(), "python": platform.python_version(),
                             "torch": torch.__version__, "build": build_info()}
    if device == "cuda":
        properties = torch.cuda.get_device_properties("cuda")
        found |= {"gpu": properties.name, "gpu_memory_bytes": properties.total_memory, "cuda": torch.version.cuda}
    return found


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
