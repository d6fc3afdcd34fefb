"""Items in one process: read by some threads, drawn by one, written by others, so that the device need not wait."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Semaphore
from typing import Any, Protocol

from lightfield_gs.base.cli_messages import capture, is_out_of_memory
from lightfield_gs.base.errors import InputError

PARTS = ("read", "draw", "write")
DRAWN_AHEAD = 2  # images that wait to be written, beside those that are: no more, for they are large
_BROKEN_DEVICE = "CUDA error"  # torch's words, after which a process can use its GPU no more
Record = dict[str, Any]


class Task(Protocol):
    """What becomes of one item, in three parts, each in a thread of its own."""

    def read(self) -> bool:
        """The host's part before; whether there is anything to be done."""

    def draw(self) -> None:
        """The part that needs the device."""

    def write(self) -> None:
        """The host's part after."""

    def record(self) -> Record:
        """What is to be told of the item, as far as it came."""


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
    """Takes items and tells how each ended.

    make: the task of an item. began(number): is told before an item is read. done(number, record): how it ended, by
    "status" ("done", "failed", or what the task says), with "reason" where it failed, "seconds" of each part, and lines
    that were "said". broken(number, reason): is told where an item left the device unusable, as the whole process is
    then; it should not return. All three are called from several threads.
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
        self._room = Semaphore(writers + DRAWN_AHEAD)

    def submit(self, number: int, item: Any) -> None:
        """Begins with an item as soon as there is a thread for it."""
        self._pools["read"].submit(self._read, number, item)

    def _read(self, number: int, item: Any) -> None:
        self._began(number)
        running = _Running(number)
        is_to_do = False
        with self._part("read", running):
            running.task = self._make(item)
            is_to_do = running.task.read()
        self._go_on(running, "draw", self._draw, is_to_do)

    def _draw(self, running: _Running) -> None:
        self._room.acquire()
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
        """Times a part, keeps what is said in it, and notes why it failed."""
        began = time.perf_counter()
        try:
            with capture(running.messages):
                yield
        except (Exception, SystemExit) as error:  # whatever it is, the items beside it are not to suffer
            running.reason = _words(error)
            if not isinstance(error, InputError):
                running.trace = traceback.format_exc()
            if _BROKEN_DEVICE in str(error) and not is_out_of_memory(error):
                self._broken(running.number, running.reason)
        finally:
            running.seconds[name] = round(time.perf_counter() - began, 4)

    def _end(self, running: _Running) -> None:
        if running.is_drawn:
            self._room.release()
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


def _words(error: BaseException) -> str:
    """Why an item failed, in one line."""
    words = " ".join(str(error).split())[:1000]
    if isinstance(error, InputError):
        return words
    if is_out_of_memory(error):
        return f"out of memory; use a smaller scene or panel, or fewer processes ({words})"
    return f"{type(error).__name__}: {words}"
