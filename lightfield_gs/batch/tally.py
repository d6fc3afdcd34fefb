"""How far a batch is, how fast it goes, and what holds it up."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from lightfield_gs.base.checks import counted
from lightfield_gs.batch.pipeline import PARTS
from lightfield_gs.batch.worker import Place

_SHOWN_EVERY_S, _LINE_EVERY_S = 0.5, 30.0  # on a terminal; elsewhere, where every one stays
_VERBS = {"read": "reading", "draw": "drawing", "write": "writing"}


@dataclass
class _Worker:
    start_s: float = 0.0  # until it was ready
    ready: float = 0.0  # when that was
    last: float = 0.0  # when its last item ended
    items: int = 0
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))


class Tally:
    """Counts items as they end. places: of the processes; total: items that are to be done; shown: whether a line tells
    of it on stderr: over and over on a terminal, else every half minute."""

    def __init__(self, places: Sequence[Place], total: int, shown: bool = True):
        self._places, self._total, self._shown = places, total, shown
        self._workers = [_Worker() for _ in places]
        self._began = time.perf_counter()
        self._ready: float | None = None
        self._last_line = self._began
        self.done = self.failed = 0

    def ready(self, worker: int, seconds: float) -> None:
        """Notes that a process can begin."""
        now = time.perf_counter()
        own = self._workers[worker]
        own.start_s, own.ready = seconds, own.ready or now
        self._ready = self._ready or now

    def ended(self, record: dict[str, Any], worker: int) -> None:
        """Notes how an item ended."""
        own = self._workers[worker]
        own.last, own.items = time.perf_counter(), own.items + 1
        for part, seconds in record["seconds"].items():
            own.seconds[part] += seconds
        if record["status"] == "failed":
            self.failed += 1
        else:
            self.done += 1

    def show(self) -> None:
        """Writes the line where it is time for it."""
        now, terminal = time.perf_counter(), sys.stderr.isatty()
        if self._shown and now - self._last_line >= (_SHOWN_EVERY_S if terminal else _LINE_EVERY_S):
            self._last_line = now
            text = self.line()
            print(f"\r\x1b[K{text}" if terminal else text, end="" if terminal else "\n", file=sys.stderr, flush=True)

    def clear(self) -> None:
        """Removes the line of a terminal."""
        if self._shown and sys.stderr.isatty():
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def line(self) -> str:
        """For example "120 of 1000, 2 failed, 18.3 a second, 48 s left"."""
        ended = self.done + self.failed
        words = [f"{ended} of {self._total}"] + ([f"{self.failed} failed"] if self.failed else [])
        if ended:
            rate = ended / self._drawn_s()
            words += [f"{rate:.3g} a second", f"{_time((self._total - ended) / rate)} left"]
        return ", ".join(words)

    def summary(self) -> list[str]:
        """Seconds in all, items a second once a process could begin, and a line for each process: its seconds in
        reading, drawing and writing, and of how much of their time its threads spent them."""
        ended, wall = self.done + self.failed, time.perf_counter() - self._began
        start = 0.0 if self._ready is None else self._ready - self._began
        rate = ended / self._drawn_s()
        lines = [f"{counted(ended)} in {wall:.1f} s: {start:.1f} s to begin, then {rate:.3g} a second"]
        return lines + [self._words(*pair) for pair in zip(self._places, self._workers) if pair[1].items]

    def _drawn_s(self) -> float:
        """Seconds from when the first process could begin until the last item ended."""
        last = max(worker.last for worker in self._workers)
        return max(last - (self._ready or self._began), 1e-9)

    def _words(self, place: Place, worker: _Worker) -> str:
        wall = max(worker.last - worker.ready, 1e-9)
        threads = {"read": place.readers, "draw": 1, "write": place.writers}
        shares = {part: worker.seconds[part] / (wall * threads[part]) for part in PARTS}
        parts = [
            f"{_VERBS[part]} {worker.seconds[part]:.1f} s, {shares[part]:.0%} of {counted(threads[part], 'thread')}"
            for part in PARTS
        ]
        most = max(PARTS, key=lambda part: shares[part])
        return (
            f"{place.name}: {counted(worker.items)} in {wall:.1f} s after {worker.start_s:.1f} s of start: "
            f"{'; '.join(parts)}; bound by {_VERBS[most]}"
        )


def _time(seconds: float) -> str:
    """For example "48 s", "12 min", "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
