"""What a render did, counted and timed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.rasterizer import skips


@dataclass
class Stats:
    """What a render did: milliseconds per stage, counts, bytes of work memory.

    device: where the work is done. At both ends of a stage its host waits for a CUDA device, or the work of one stage
    would be timed in another. None: nothing waits, and stages of a device have no times that mean anything.
    """

    device: torch.device | None = None
    stages_ms: dict[str, float] = field(default_factory=dict)
    pairs: int = 0
    evaluations: int = 0
    work_bytes: int = 0
    memory_bytes: dict[str, int] = field(default_factory=dict)  # of method sorted, see encode_sorted
    memory_bytes_unchunked: dict[str, int] = field(default_factory=dict)
    images: int = 0
    gaussians_drawn: int = 0  # in all images
    pruned: int = 0  # of a light field, see Quality
    colour_error: float = 0.0
    kernel: str | None = None  # that drew a light field on CUDA
    skipped: dict[str, Any] = field(default_factory=dict)  # of a light field, see skips.lines

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time of what is done within to the stage of this name."""
        self._wait()
        start = time.perf_counter()
        yield
        self._wait()
        self.stages_ms[name] = self.stages_ms.get(name, 0.0) + 1e3 * (time.perf_counter() - start)

    def _wait(self) -> None:
        if self.device is not None and self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def add_render(self, other: Stats) -> None:
        """Adds one of several renders that follow each other: their work adds up, their memory is used again."""
        for name, ms in other.stages_ms.items():
            self.stages_ms[name] = self.stages_ms.get(name, 0.0) + ms
        self.pairs += other.pairs
        self.evaluations += other.evaluations
        self.images += other.images
        self.gaussians_drawn += other.gaussians_drawn
        self.work_bytes = max(self.work_bytes, other.work_bytes)

    def add_buffers(self, *buffers: Tensor) -> None:
        """Adds the sizes of these to the work memory."""
        self.work_bytes += sum(t.numel() * t.element_size() for t in buffers)

    def count_frame(self, state: dict[str, Any], work: Tensor) -> None:
        """Adds a light-field frame on CUDA, by the state that it found out, and its work buffer."""
        self.pairs += state["intersections"]
        self.images += 1
        self.gaussians_drawn += state["drawn"]
        self.colour_error, self.kernel, self.pruned = state["colour_error"], state["kernel"], state["pruned"]
        self.skipped = skips.of_frame(state)
        self.add_buffers(work)

    def count(self, counters: _core.Counters) -> None:
        """Adds what the core counted in a composite."""
        self.pairs += counters.intersections
        self.evaluations += counters.evaluations
        self.work_bytes += counters.scratch_bytes

    def report(self, gaussians: int, subpixels: int) -> dict[str, Any]:
        """What `encode` tells in its stats; gaussians: how many there are. Evaluations are not counted on CUDA."""
        on_cuda = self.device is not None and self.device.type == "cuda"
        found: dict[str, Any] = {
            "stages_ms": dict(self.stages_ms),
            "pairs": self.pairs,
            "evaluations": None if on_cuda else self.evaluations,
            "evaluations_per_subpixel": None if on_cuda else self.evaluations / subpixels,
            "work_bytes": self.work_bytes,
            "gaussians_culled": gaussians - self.gaussians_drawn // max(self.images, 1),
            "colour_error": self.colour_error,
        }
        if self.kernel is not None:
            found["kernel"] = self.kernel
        if self.memory_bytes:
            found |= {"memory_bytes": self.memory_bytes, "memory_bytes_unchunked": self.memory_bytes_unchunked}
        return found
