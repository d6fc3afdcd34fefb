"""How a live picture fares: frames a second, dropped ones, latency, and which stage bounds them."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

from lightfield_gs.live.sources import Frame

_BUSY = 0.75  # part of the time from which on a stage, not the source, bounds the rate


class Took(NamedTuple):
    """How long a stage took for a picture.

    Attributes:
        seconds: That.
        taken: When the source gave the picture, seconds of time.monotonic.
    """

    seconds: float
    taken: float


@dataclass
class Span:
    """What happened within some seconds.

    Attributes:
        began: Seconds of time.monotonic.
        seconds: How long it was; 0 while it lasts.
        taken: Pictures that the source gave.
        drawn: Pictures of the panel that were made.
        latencies_s: From taken to sent, of each picture that was sent.
        busy_s: Of each stage.
        took: How long each stage took for each picture that it finished.
        works: How long each stage that works now has done so.
        unused: Reasons why pictures could not be used, and of how many.
    """

    began: float = field(default_factory=time.monotonic)
    seconds: float = 0.0
    taken: int = 0
    drawn: int = 0
    latencies_s: list[float] = field(default_factory=list)
    busy_s: dict[str, float] = field(default_factory=dict)
    took: dict[str, list[Took]] = field(default_factory=dict)
    works: dict[str, Took] = field(default_factory=dict)
    unused: dict[str, int] = field(default_factory=dict)

    @property
    def shown(self) -> int:
        """Pictures that were sent."""
        return len(self.latencies_s)

    @property
    def bound(self) -> str:
        """The stage that bounds the rate: the busiest, or the source where all of them wait for it."""
        name, busy = max(self.busy_s.items(), key=lambda item: item[1], default=("source", 0.0))
        return name if self.seconds > 0 and busy >= _BUSY * self.seconds else "source"

    def line(self, hint: str = "") -> str:
        """Return the health line, with a hint where pictures are drawn and none is shown."""
        rate = 1 / max(self.seconds, 1e-9)
        unused = sum(self.unused.values())
        parts = [f"{self.shown * rate:.1f} frames a second shown"]
        if not self.shown and self.drawn:
            parts = [f"{self.drawn * rate:.1f} frames a second drawn, none shown{hint}"]
        parts.append(f"{max(0, self.taken - max(self.shown, self.drawn) - unused)} of {self.taken} dropped")
        if self.shown:
            parts.append(f"{1000 * median(self.latencies_s):.0f} ms from taken to sent")
        parts += [f"{count} not used: {reason}" for reason, count in self.unused.items()]
        return ", ".join([*parts, f"bound by the {self.bound}"])


@dataclass
class _Since:
    """A stage that works: since when, up to when that is counted, and when its picture was taken."""

    began: float
    counted: float
    taken: float


class Health:
    """Counts, from all threads."""

    def __init__(self) -> None:
        self._lock, self._span = threading.Lock(), Span()
        self._since: dict[str, _Since] = {}  # the stages that work
        self.shown, self.drawn, self.taken = 0, 0, 0
        self._last_drawn, self._last_sent = -1, -1

    def has_taken(self, frame: Frame) -> None:
        """Count a picture of the source."""
        with self._lock:
            self._span.taken += 1
            self.taken += 1

    def has_drawn(self, frame: Frame) -> None:
        """Count a picture of the panel; the first of a frame, which may be drawn again."""
        with self._lock:
            if frame.number <= self._last_drawn:
                return
            self._last_drawn = frame.number
            self._span.drawn += 1
            self.drawn += 1

    def has_sent(self, frame: Frame) -> None:
        """Count a picture whose last byte is on its way, or in the hands of the recorder; the first of a frame."""
        with self._lock:
            if frame.number <= self._last_sent:
                return
            self._last_sent = frame.number
            self._span.latencies_s.append(time.monotonic() - frame.taken)
            self.shown += 1

    def could_not_use(self, reason: str) -> None:
        """Count a picture of which no scene could be made."""
        with self._lock:
            self._span.unused[reason] = self._span.unused.get(reason, 0) + 1

    def begin(self, stage: str, frame: Frame | None = None) -> None:
        """Count the time of a stage from now on, for a picture."""
        with self._lock:
            now = time.monotonic()
            self._since.setdefault(stage, _Since(now, now, now if frame is None else frame.taken))

    def end(self, stage: str) -> None:
        """Count it no more; nothing happens where it has not begun."""
        with self._lock:
            if (since := self._since.pop(stage, None)) is not None:
                now = time.monotonic()
                self._add_busy(stage, now - since.counted)
                self._span.took.setdefault(stage, []).append(Took(now - since.began, since.taken))

    @contextmanager
    def busy(self, stage: str, frame: Frame) -> Iterator[None]:
        """Count the time of the block for a stage."""
        self.begin(stage, frame)
        yield
        self.end(stage)

    def take(self) -> Span:
        """Return what happened since the last call, and the part of what is on its way."""
        with self._lock:
            now = time.monotonic()
            for stage, since in self._since.items():
                self._add_busy(stage, now - since.counted)
                since.counted = now
                self._span.works[stage] = Took(now - since.began, since.taken)
            span, self._span = self._span, Span(now)
        span.seconds = now - span.began
        return span

    def _add_busy(self, stage: str, seconds: float) -> None:
        self._span.busy_s[stage] = self._span.busy_s.get(stage, 0.0) + seconds
