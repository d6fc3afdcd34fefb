"""One method of the benchmark: its image, its times and its counters."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import torch
from torch import Tensor

from lightfield_gs.base.options import Method
from lightfield_gs.bench.peers import PEERS
from lightfield_gs.bench.timing import timed
from lightfield_gs.encoding.encode import encode
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians


@dataclass(frozen=True)
class Measurement:
    """An 8-bit image [H, W, 3], the times of the runs that made it (ms, in their order), and counters.

    stats: as `encode` fills them; peak_bytes: most device memory held beyond the scene and the image, None on the CPU.
    """

    image: Tensor
    times_ms: list[float]
    stats: dict[str, Any]
    peak_bytes: int | None = None

    def summary(self) -> dict[str, float]:
        """ms_median, ms_min, ms_max and the number of runs."""
        return {
            "ms_median": statistics.median(self.times_ms),
            "ms_min": min(self.times_ms),
            "ms_max": max(self.times_ms),
            "runs": len(self.times_ms),
        }


def measure(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    method: str,
    repeats: int | None = None,
    threads: int | None = None,
    memory_budget: int | None = None,
) -> Measurement:
    """Times a method of `encode`, or a peer, from Gaussians on their device to the 8-bit image on it.

    "direct" on CUDA is an Encoder's replayed frame. repeats: runs that count; None: as many as `timed` chooses.
    threads, memory_budget: as `encode` takes them, the latter for "sorted" alone. Raises InputError.
    """
    if method in PEERS:
        peer = PEERS[method](gaussians, panel, rig)
        image, times = timed(peer, True, repeats)
        return Measurement(image, times, *_counted_on_cuda(peer.counted, image))
    draw = partial(encode, gaussians, panel, rig, cast(Method, method), threads=threads, memory_budget=memory_budget)
    if not gaussians.means.is_cuda:
        return _measure_on_cpu(draw, repeats)

    def counted() -> dict[str, Any]:  # apart from timing, for it makes the stages wait for each other
        stats: dict[str, Any] = {}
        draw(stats=stats)
        return stats

    frame = partial(Encoder(panel, rig), gaussians) if method == "direct" else draw
    image, times = timed(frame, True, repeats)
    return Measurement(image, times, *_counted_on_cuda(counted, image))


def _measure_on_cpu(draw: Callable[..., Tensor], repeats: int | None) -> Measurement:
    """Here counting costs nothing: the counters are those of the run of median time."""
    collected: list[dict[str, Any]] = []

    def counted() -> Tensor:
        collected.append({})
        return draw(stats=collected[-1])

    image, times = timed(counted, False, repeats)
    by_time = sorted(range(len(times)), key=times.__getitem__)
    return Measurement(image, times, collected[by_time[(len(times) - 1) // 2]])


def _counted_on_cuda(counted: Callable[[], dict[str, Any]], image: Tensor) -> tuple[dict[str, Any], int]:
    """The counters, and the device memory that collecting them held at most beyond what was held before."""
    before = torch.cuda.memory_allocated(image.device)
    torch.cuda.reset_peak_memory_stats(image.device)
    stats = counted()
    return stats, torch.cuda.max_memory_allocated(image.device) - before - image.numel()
