"""The pipeline of one process: threads read, one thread draws, threads write, so that the device need not wait."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Semaphore
from typing import Any, Protocol

from lightfield_gs.base.cli_messages import as_options, capture, is_out_of_memory
from lightfield_gs.base.errors import InputError

PARTS = ("read", "draw", "write")
DRAWN_AHEAD = 2  # images in the queue of the writers; few, because they are large
_BROKEN_DEVICE = "CUDA error"  # torch's message, after which a process can use its GPU no more
Record = dict[str, Any]


class Task(Protocol):
    """The work on one item, in three parts, each in a thread of its own."""

    def read(self) -> bool:
        """Do the host's part before drawing; return whether there is anything to draw."""

    def draw(self) -> None:
        """Do the part that needs the device."""

    def write(self) -> None:
        """Do the host's part after drawing."""

    def record(self) -> Record:
        """Return the item's entries for the manifest, as far as they are known."""


@dataclass
class _Running:
    number: int
    task: Task | None = None
    messages: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    reason: str | None = None
    trace: str | None = None
    is_drawn: bool = False  # or being drawn


class Pipeline:
    """Runs tasks. All callbacks are called from several threads.

    Args:
        make: function that makes the task of an item.
        readers, writers: numbers of threads.
        began: called with an item's number before it is read.
        done: called with an item's number and record. The record has "status" ("done", "failed", or the task's),
            "reason" and "trace" of a failure, "seconds" of each part, and as "said" the printed lines.
        broken: called with the number of an item after which the device is unusable, and the reason; must not return.
    """

    def __init__(
        self,
        make: Callable[[Any], Task],
        readers: int,
        writers: int,
        began: Callable[[int], None],
        done: Callable[[int, Record], None],
        broken: Callable[[int, str], None],
    ):
        self._make, self._began, self._done, self._broken = make, began, done, broken
        self._pools: dict[str, Executor] = {
            part: ThreadPoolExecutor(count, thread_name_prefix=part)
            for part, count in zip(PARTS, (readers, 1, writers))
        }
        self._drawn = Semaphore(writers + DRAWN_AHEAD)

    def submit(self, number: int, item: Any) -> None:
        """Begin an item as soon as a thread is free."""
        self._pools["read"].submit(self._read, number, item)

    def close(self, wait: bool = True) -> None:
        """End the threads after the items in progress, or before their next part."""
        for pool in self._pools.values():
            pool.shutdown(wait, cancel_futures=not wait)

    def _read(self, number: int, item: Any) -> None:
        self._began(number)
        running = _Running(number)
        is_to_do = False
        with self._part("read", running):
            running.task = self._make(item)
            is_to_do = running.task.read()
        self._go_on(running, "draw", self._draw, is_to_do)

    def _draw(self, running: _Running) -> None:
        self._drawn.acquire()
        running.is_drawn = True
        with self._part("draw", running):
            assert running.task is not None
            running.task.draw()
        self._go_on(running, "write", self._write, True)

    def _write(self, running: _Running) -> None:
        with self._part("write", running):
            assert running.task is not None
            running.task.write()
        self._end(running)

    def _go_on(self, running: _Running, part: str, call: Callable[[_Running], None], is_to_do: bool) -> None:
        if running.reason is None and is_to_do:
            self._pools[part].submit(call, running)
        else:
            self._end(running)

    @contextmanager
    def _part(self, name: str, running: _Running) -> Iterator[None]:
        """Time a part, capture its messages, and note the reason of a failure."""
        began = time.perf_counter()
        try:
            with capture(running.messages):
                yield
        except (Exception, SystemExit) as error:  # of any kind: other items must not suffer
            running.reason = _reason(error)
            if not isinstance(error, InputError):
                running.trace = traceback.format_exc()
            if _BROKEN_DEVICE in str(error) and not is_out_of_memory(error):
                self._broken(running.number, running.reason)
        finally:
            running.seconds[name] = round(time.perf_counter() - began, 4)

    def _end(self, running: _Running) -> None:
        if running.is_drawn:
            self._drawn.release()
        record: Record = {"status": "done" if running.reason is None else "failed"}
        if running.task is not None:
            told = running.task.record()
            record = record | told if running.reason is None else told | record
        if running.reason is not None:
            record["reason"] = running.reason
        if running.trace is not None:
            record["trace"] = running.trace
        record["said"] = running.messages + record.get("said", [])
        self._done(running.number, record | {"seconds": running.seconds})


def _reason(error: BaseException) -> str:
    """Return the reason of a failure in one line."""
    words = " ".join(str(error).split())[:1000]
    if isinstance(error, InputError):
        return as_options(words)
    if is_out_of_memory(error):
        return f"out of memory; use a smaller scene or panel, or fewer processes ({words})"
    return f"{type(error).__name__}: {words}"
