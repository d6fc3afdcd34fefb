"""Times of the stages of a command."""

from __future__ import annotations

import time


class Stopwatch:
    """Collects named times in seconds; `lap` takes the time since the last lap, or since `began` (perf_counter)."""

    def __init__(self, began: float) -> None:
        self._start = self._last = began
        self.stages: list[tuple[str, float]] = []

    def lap(self, name: str, parts_ms: dict[str, float] | None = None) -> None:
        """Ends a stage. With `parts_ms` its parts are listed by their own names, and the rest of it as `name`."""
        now = time.perf_counter()
        seconds = now - self._last
        for part, milliseconds in (parts_ms or {}).items():
            self.stages.append((part, milliseconds / 1000))
            seconds -= milliseconds / 1000
        if parts_ms is None or seconds >= 0.005:
            self.stages.append((name, seconds))
        self._last = now

    def line(self) -> str:
        """For example "load 0.12 s, composite 0.80 s, write 0.21 s, total 1.13 s"."""
        total = ("total", self._last - self._start)
        return ", ".join(f"{name} {seconds:.2f} s" for name, seconds in [*self.stages, total])
