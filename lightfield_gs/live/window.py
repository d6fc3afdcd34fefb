"""The way out to a window of the program's own."""

from __future__ import annotations

import threading

from lightfield_gs.live.health import Health
from lightfield_gs.live.outs import Drawn
from lightfield_gs.live.slot import Slot
from lightfield_gs.live.sources import Frame
from lightfield_gs.show.window.native_window import NativeWindow

_LONGEST_WAIT_S = 0.1  # after which Ctrl-C is heeded


class WindowOut:
    """Hands pictures to a window, which the main thread fills: the newest alone.

    Args:
        window: The window.
        health: Counts.
    """

    def __init__(self, window: NativeWindow, health: Health):
        self._window, self._health = window, health
        self._newest: Slot[tuple[Frame, Drawn]] = Slot()

    def put(self, frame: Frame, drawn: Drawn) -> None:
        """See Out."""
        self._newest.put((frame, drawn))
        self._window.wake()

    def run(self, is_over: threading.Event) -> None:
        """Show pictures until the user ends it, or is_over is set; in the main thread."""
        is_open = True
        while is_open:
            is_open = self._window.handle_events(_LONGEST_WAIT_S) and not is_over.is_set()
            if (item := self._newest.take()) is not None:
                frame, drawn = item
                with self._health.busy("window", frame):
                    self._window.show(drawn.image)
                self._health.has_sent(frame)
