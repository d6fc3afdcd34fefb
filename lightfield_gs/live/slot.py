"""What one thread hands to the next: the newest alone, so that nothing queues."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Generic, TypeVar

import torch

from lightfield_gs.base.cli_messages import capture

_T = TypeVar("_T")
_LONGEST_WAIT_S = 0.5  # after which Ctrl-C is heeded on any system


class Slot(Generic[_T]):
    """A place for one thing between two threads. A newer one takes the place of one that nobody has taken."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: _T | None = None
        self._is_closed = False

    def put(self, item: _T) -> None:
        """Leave a thing for the next thread."""
        with self._changed:
            self._item = item
            self._changed.notify_all()

    def close(self) -> None:
        """Tell the next thread that nothing more comes."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def take(self) -> _T | None:
        """Return the newest thing; None where there is none."""
        with self._changed:
            return self._taken()

    def wait_taken(self) -> None:
        """Wait until the next thread has taken what is here, or the slot is closed."""
        with self._changed:
            while self._item is not None and not self._is_closed:
                self._changed.wait(_LONGEST_WAIT_S)

    def __iter__(self) -> Iterator[_T]:
        """Yield each thing as soon as it is there, until the slot is closed and empty."""
        return (item for item in self.within(_LONGEST_WAIT_S) if item is not None)

    def within(self, seconds: float) -> Iterator[_T | None]:
        """Yield each thing as soon as it is there, and None as often as none came for so long; see __iter__."""
        while True:
            with self._changed:
                if self._item is None and not self._is_closed:
                    self._changed.wait(seconds)
                item = self._taken()
                is_over = item is None and self._is_closed
            if is_over:
                return
            yield item

    def _taken(self) -> _T | None:
        item, self._item = self._item, None
        self._changed.notify_all()
        return item


def in_thread(name: str, items: Iterator[_T]) -> Iterator[_T]:
    """Yield items, which a thread of their own makes meanwhile; of those that are not taken, the newest alone.

    Args:
        name: Of the thread.
        items: They end when their own source does. What they say is not printed; what they raise is raised here.
    """
    slot: Slot[_T] = Slot()
    failed: list[BaseException] = []

    def run() -> None:
        try:
            with torch.inference_mode(), capture([]):
                for item in items:
                    slot.put(item)
        except BaseException as error:  # a thread would swallow it
            failed.append(error)
        finally:
            slot.close()

    threading.Thread(target=run, name=name, daemon=True).start()
    yield from slot
    if failed:
        raise failed[0]
