"""The thread that reads a source: the newest picture alone is kept, and a source that fails is opened again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

from lightfield_gs.base.errors import InputError
from lightfield_gs.live.slot import Slot
from lightfield_gs.live.sources import Frame, Source

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0


class Reader:
    """Reads a source in a thread of its own.

    Args:
        source: The source.
        seen: Called with each picture.
        say: Called with a line, where the source fails and where it is back.
        holds_film: Whether a film stays at a picture until `first` asks for the next one, or `go_on` is called.

    Attributes:
        newest: Where the pictures go; closed at the end.
        failed: The error by which the source could not be opened at first, or a film could not be read.
    """

    def __init__(
        self,
        source: Source,
        seen: Callable[[Frame], None],
        say: Callable[[str], None],
        first_pause_s: float = _FIRST_PAUSE_S,
        holds_film: bool = False,
    ):
        self._source, self._seen, self._say, self._first_pause_s = source, seen, say, first_pause_s
        self.newest: Slot[Frame] = Slot()
        self.failed: BaseException | None = None
        self._stop, self._goes_on, self._holds = threading.Event(), threading.Event(), holds_film
        self._thread = threading.Thread(target=self._run, name="source", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def first(self) -> Iterator[Frame]:
        """Yield the first pictures, by which something is settled that takes its time: see holds_film."""
        for frame in self.newest:
            yield frame
            self._goes_on.set()

    def go_on(self) -> None:
        """Hold a film no longer."""
        self._holds = False
        self._goes_on.set()

    def stop(self) -> None:
        """End, without waiting: a device may keep its thread until its next picture."""
        self._stop.set()
        self.go_on()

    def _run(self) -> None:
        try:
            self._read()
        except BaseException as error:  # a thread would swallow it
            self.failed = error
        finally:
            self.newest.close()

    def _read(self) -> None:
        pause, has_begun, is_away = self._first_pause_s, False, False
        while not self._stop.is_set():
            try:
                for frame in self._source.frames(self._stop):
                    if is_away:
                        self._say(f"{self._source.name}: it is back")
                    has_begun, is_away, pause = True, False, self._first_pause_s
                    self._seen(frame)
                    self.newest.put(frame)
                    if self._holds and self._source.ends:
                        self._goes_on.wait()
                        self._goes_on.clear()
                if self._source.ends or self._stop.is_set():
                    return
                reason = "it sends no more pictures"
            except InputError as error:
                if not has_begun or self._source.ends:
                    raise
                reason = str(error)
            is_away = True
            words = reason if reason.startswith(self._source.name) else f"{self._source.name}: {reason}"
            self._say(f"{words}; it is opened again in {pause:g} s")
            self._stop.wait(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)
