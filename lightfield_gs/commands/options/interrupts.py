"""Ctrl-C and SIGTERM in a command that can stop in good order: the first asks for that, a second one aborts."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType
from typing import Any

_NUMBERS = (signal.SIGINT, signal.SIGTERM)


class Interrupts:
    """While it is entered, `number` is that of the first signal that came, or None. A second one is a
    KeyboardInterrupt. Outside the main thread signals go their usual way."""

    def __init__(self) -> None:
        self.number: int | None = None
        self._usual: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._usual = {number: signal.signal(number, self._came) for number in _NUMBERS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._usual.items():
            signal.signal(number, handler)

    def _came(self, number: int, frame: FrameType | None) -> None:
        if self.number is not None:
            raise KeyboardInterrupt
        self.number = number
        print("\nstops after this step and writes the scene; once more to abort", file=sys.stderr, flush=True)
