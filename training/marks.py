"""Where the time of a training step goes."""

from __future__ import annotations

import statistics
import time
from typing import NamedTuple

import torch
from torch import Tensor


class NoMarks:
    """Marks of a trainer that nobody measures."""

    def mark(self, part: str) -> None:
        """A part of a step ends."""

    def mark_at_gradient(self, tensor: Tensor, part: str) -> None:
        """A part of the backward ends where the gradient of a tensor is known."""


class PartTime(NamedTuple):
    """Median milliseconds of a part of a step. device: between events on the device, its idle time included; None on a
    CPU. host: what Python, torch and the driver take to queue it, waiting included."""

    part: str
    device_ms: float | None
    host_ms: float


class StepMarks(NoMarks):
    """Times of the parts between marks, on the host and on a device's stream; nothing waits for the device."""

    def __init__(self, device: torch.device) -> None:
        self._cuda = device.type == "cuda"
        self._marks: list[tuple[str, float, torch.cuda.Event | None]] = []

    def mark(self, part: str) -> None:
        event = torch.cuda.Event(enable_timing=True) if self._cuda else None
        if event is not None:
            event.record()
        self._marks.append((part, time.perf_counter(), event))

    def mark_at_gradient(self, tensor: Tensor, part: str) -> None:
        tensor.register_hook(lambda _: self.mark(part))

    def medians(self) -> list[PartTime]:
        """Of all parts in the order in which they came first, from the first mark on; waits for the device."""
        if self._cuda:
            torch.cuda.synchronize()
        times: dict[str, list[tuple[float, float]]] = {}
        for (_, began, before), (part, ended, after) in zip(self._marks, self._marks[1:]):
            device_ms = before.elapsed_time(after) if self._cuda else 0.0
            times.setdefault(part, []).append((device_ms, 1e3 * (ended - began)))
        found = ((part, *map(statistics.median, zip(*values))) for part, values in times.items())
        return [PartTime(part, device_ms if self._cuda else None, host_ms) for part, device_ms, host_ms in found]
