"""The clock of the benchmarks, and the machine that it ran on."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch

from lightfield_gs import build_info
from lightfield_gs.base.system import cores, processor

SECONDS_PER_CALL = 60.0  # a call whose runs have taken so long together is not run again
SHORT_MS = 50.0  # on CUDA calls that take less are repeated more often, for one hiccup moves their median further
REPEATS, SHORT_REPEATS = 5, 20
# The beginning that does not count on CUDA, whichever lasts longer: kernels load, the allocator fills, clocks rise
WARM_UP, WARM_UP_MS = 2, 100.0
AHEAD_CYCLES = 2_000_000  # a millisecond, in which the host gets ahead of the device: a render's forward takes it 1 ms


def timed(
    call: Callable[[], Any], cuda: bool, repeats: int | None = None, ahead: bool = True
) -> tuple[Any, list[float]]:
    """Return the last result of a call, and the times of the runs in ms, in their order; runs as in timed_in_turn."""
    result, times = timed_in_turn([call], cuda, repeats, ahead)
    return result, [ms for (ms,) in times]


def timed_in_turn(
    calls: Sequence[Callable[[], Any]], cuda: bool, repeats: int | None = None, ahead: bool = True
) -> tuple[Any, list[tuple[float, ...]]]:
    """Run several calls one after the other; return the last call's last result and the ms of each call in each run.

    On CUDA the runs are warm, and each call lies between two events on the current stream. There is at least one run,
    and
    none begins after a minute.

    Args:
        repeats: Number of runs. None: 20 if they take less than 50 ms on CUDA, else 5.
        ahead: Keep the device busy at first, so that the host's part of the first call does not count, as in the
            others.
    """
    clock = partial(_cuda_ms, ahead=ahead) if cuda else _wall_ms
    repeats = _warmed_up(clock, calls, cuda, repeats)
    times: list[tuple[float, ...]] = []
    while len(times) < repeats and (not times or sum(map(sum, times)) < 1e3 * SECONDS_PER_CALL):
        result, took = clock(calls)
        times.append(took)
    return result, times


def timed_by_turns(
    programs: Sequence[Sequence[Callable[[], Any]]], cuda: bool, repeats: int | None = None
) -> list[list[tuple[float, ...]]]:
    """Time several programs by turns, each of several calls; return for each program the runs as in timed_in_turn.

    So other load on the machine affects all alike. Every program has as many runs as the program that needs the most.
    """
    clock = partial(_cuda_ms, ahead=True) if cuda else _wall_ms
    repeats = max(_warmed_up(clock, calls, cuda, repeats) for calls in programs)
    times: list[list[tuple[float, ...]]] = [[] for _ in programs]
    began = time.perf_counter()
    while len(times[0]) < repeats and (not times[0] or time.perf_counter() - began < SECONDS_PER_CALL):
        for calls, taken in zip(programs, times):
            taken.append(clock(calls)[1])
    return times


def ms_in_a_row(call: Callable[[], Any], cuda: bool, count: int) -> float:
    """Return the wall time in ms of one call, from `count` calls without waits between them."""
    began = time.perf_counter()
    for _ in range(count):
        call()
    if cuda:
        torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - began) / count


def _warmed_up(clock: Callable[..., Any], calls: Sequence[Callable[[], Any]], cuda: bool, repeats: int | None) -> int:
    """Warm up, and return the number of runs to time."""
    warm: list[float] = []
    spent = 0.0
    while cuda and (len(warm) < WARM_UP or spent < WARM_UP_MS):
        warm.append(sum(clock(calls)[1]))
        spent += warm[-1]
    if repeats is None:
        return SHORT_REPEATS if cuda and warm[-1] < SHORT_MS else REPEATS
    return repeats


def _wall_ms(calls: Sequence[Callable[[], Any]]) -> tuple[Any, tuple[float, ...]]:
    marks = [time.perf_counter()]
    for call in calls:
        result = call()
        marks.append(time.perf_counter())
    return result, tuple(1e3 * (end - start) for start, end in zip(marks, marks[1:]))


def _cuda_ms(calls: Sequence[Callable[[], Any]], ahead: bool) -> tuple[Any, tuple[float, ...]]:
    if ahead:
        torch.cuda._sleep(AHEAD_CYCLES)
    marks = [torch.cuda.Event(enable_timing=True) for _ in range(len(calls) + 1)]
    marks[0].record()
    for call, mark in zip(calls, marks[1:]):
        result = call()
        mark.record()
    marks[-1].synchronize()
    return result, tuple(start.elapsed_time(end) for start, end in zip(marks, marks[1:]))


def machine(device: str) -> dict[str, Any]:
    """Return the environment of the times: processor, cores, GPU, versions."""
    found: dict[str, Any] = {
        "processor": processor(),
        "cores": len(cores()),
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "build": build_info(),
    }
    if device == "cuda":
        properties = torch.cuda.get_device_properties("cuda")
        found |= {"gpu": properties.name, "gpu_memory_bytes": properties.total_memory, "cuda": torch.version.cuda}
    return found


def machine_line(found: dict[str, Any]) -> str:
    """Return a line on the machine of the times."""
    gpu = f"{found['gpu']}, CUDA {found['cuda']}, " if "gpu" in found else ""
    return f"{gpu}{found['processor']}, {found['cores']} cores, torch {found['torch']}"
