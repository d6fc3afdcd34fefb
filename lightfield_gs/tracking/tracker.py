"""The thread that follows a viewer's eyes: where they are now, and a word where they are lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

from lightfield_gs.panels.comfort import EYE_SEPARATION_MM
from lightfield_gs.panels.panel import Panel
from lightfield_gs.tracking.motion import EyeMotion
from lightfield_gs.tracking.sources import EyeSource

_LOST_S = 1.0  # without eyes, after which a line says so
_OPENING_S = 15.0  # for a source to open
_RATE = 60.0  # looks a second at where the eyes are
_STEPS_MM = np.array([0.4, 0.4, 3.0])  # to the right, up and away, that a picture follows: less is not seen


class EyeTracker:
    """Follows the eyes of a source, in a thread of its own.

    Args:
        source: The source.
        panel: Before whose middle, at its viewing distance, the eyes are until they are seen.
        say: Called with a line, from any thread.
    """

    def __init__(self, source: EyeSource, panel: Panel, say: Callable[[str], None]):
        assert panel.viewing_distance_mm is not None
        self._source, self._say = source, say
        half = EYE_SEPARATION_MM / 2
        self._eyes = np.array([[-half, 0, panel.viewing_distance_mm], [half, 0, panel.viewing_distance_mm]])
        self._steady = self._eyes
        self._motion, self._lock = EyeMotion(), threading.Lock()
        self._seen: float | None = None  # when eyes were seen last
        self._is_lost = False
        self._stop, self._is_open = threading.Event(), threading.Event()
        self._failed: BaseException | None = None

    def start(self) -> list[str]:
        """Begin, wait until the source is open, and return lines on it. Raises InputError where it cannot be opened."""
        self._begin(self._run)
        self._is_open.wait(_OPENING_S)
        self._is_open.set()  # where it opens later, its failure is said
        if self._failed is not None:
            raise self._failed
        with self._lock:
            is_seen = self._seen is not None
        where = "the picture is for a viewer in the middle"
        return [] if is_seen else [f"eyes: none are seen yet by {self._source.name}; until then {where}"]

    def stop(self) -> None:
        """End, without waiting for a device that keeps its thread."""
        self._stop.set()

    def now(self, ahead_s: float = 0.0) -> np.ndarray:
        """Return where the left and the right eye are [2, 3], or will be after some seconds; see weave_eyes."""
        when = time.monotonic()
        with self._lock:
            if self._seen is None:
                return self._eyes
            if when - self._seen < _LOST_S:
                self._eyes = self._motion.at(when + ahead_s)
                return self._eyes
            is_news, self._is_lost = not self._is_lost, True
        if is_news:
            self._say("eyes: they are not seen; the picture stays for where they were")
        return self._eyes

    def steady(self, ahead_s: float = 0.0) -> np.ndarray:
        """Return what now() returns, or what was returned here before where the eyes hardly moved since."""
        eyes = self.now(ahead_s)
        if (np.abs(eyes - self._steady) > _STEPS_MM).any():
            self._steady = eyes
        return self._steady

    def follow(self, moved: Callable[[np.ndarray], None], ahead_s: Callable[[], float]) -> None:
        """Call `moved` with the eyes as often as they move, from a thread of its own; ahead_s: what now() takes."""

        def run() -> None:
            last: np.ndarray | None = None
            while not self._stop.wait(1 / _RATE):
                eyes = self.steady(ahead_s())
                if eyes is not last:
                    last = eyes
                    moved(eyes)

        self._begin(run)

    @staticmethod
    def _begin(run: Callable[[], None]) -> None:
        threading.Thread(target=run, name="eyes", daemon=True).start()

    def _run(self) -> None:
        try:
            for sample in self._source.samples(self._stop):
                if sample.eyes_mm is not None:
                    self._take(sample.taken, sample.eyes_mm)
                self._is_open.set()
            if not self._stop.is_set():
                with self._lock:
                    self._is_lost = True
                self._say(f"eyes: {self._source.name} has ended; the picture stays for where they were")
        except BaseException as error:  # a thread would swallow it
            self._failed = error
            if self._is_open.is_set():
                self._say(f"eyes: {error}; the picture stays for where they were")
        finally:
            self._is_open.set()

    def _take(self, taken: float, eyes_mm: np.ndarray) -> None:
        with self._lock:
            self._motion.update(taken, eyes_mm)
            is_back, self._is_lost = self._is_lost, False
            self._seen = max(taken, self._seen or taken)
        if is_back:
            self._say("eyes: they are seen again")
