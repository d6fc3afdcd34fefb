"""One process of a batch: threads read items, one thread draws, threads write, and the manifest records each end."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timezone
from itertools import islice
from typing import Protocol

from tqdm import tqdm

from lightfield_gs.base.checks import counted
from lightfield_gs.base.cli_messages import as_options, capturable_streams, capture, is_out_of_memory
from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.items import Item
from lightfield_gs.batch.manifest import Known, Manifest, Plan, Record

PARTS = {"read": "reading", "draw": "drawing", "write": "writing"}
DRAWN_AHEAD = 2  # images in the queue of the writers; few, because they are large
EXIT_BROKEN = 70  # of a process whose device cannot be used any more
_BROKEN_DEVICE = "CUDA error"  # torch's message, after which a process can use its GPU no more
_SWITCH_S = 2e-4  # between threads of Python: the drawing thread must not wait long for readers and writers
_TURN_S = 0.5  # of a wait, after which the main thread looks for signals
_QUEUED = 4  # items in progress beyond one for each thread that reads or writes
_DIED = "the process died of it"
_MOST_LISTED = 100  # failures, at the end


@dataclass(frozen=True)
class Worker:
    """The resources of a process.

    Attributes:
        name: for people, such as "cuda:0 process 1".
        device: cpu or cuda.
        visible: CUDA_VISIBLE_DEVICES of the process; None to leave it.
        threads: number of threads that draw on the CPU.
        readers, writers: number of threads beside the drawing thread.
    """

    name: str
    device: str
    visible: str | None = None
    threads: int = 1
    readers: int = 1
    writers: int = 1


class Task(Protocol):
    """The work on one item, in three parts; `draw` is always called in the same thread."""

    def read(self) -> bool:
        """Do the host's part before drawing; return whether there is anything to draw."""

    def draw(self) -> None:
        """Do the part that needs the device."""

    def write(self) -> None:
        """Do the host's part after drawing."""

    def record(self) -> Record:
        """Return the item's entries for the manifest, as far as they are known."""


@dataclass
class _Progress:
    """An item in progress; `failure` has the reason and perhaps the trace of a failure."""

    item: Item
    task: Task | None = None
    messages: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)
    failure: dict[str, str] = field(default_factory=dict)


class Run:
    """A run of a plan.

    Args:
        plan: the items to do.
        manifest: gets a line when an item begins and when it ends.
        worker: where the process works.
        heading: entries of the manifest's line on the run.
    """

    def __init__(self, plan: Plan, manifest: Manifest, worker: Worker, heading: Record) -> None:
        self._plan, self._manifest, self._worker, self._heading = plan, manifest, worker, heading
        self._id, self._where = now(), f"{socket.gethostname()} {worker.name}"
        self._done, self._failures, self._seconds = 0, list(plan.failures), dict.fromkeys(PARTS, 0.0)
        self._lock = threading.Lock()  # of these three
        self._in_progress: set[Item] = set()
        self._readers, self._writers = threading.Semaphore(worker.readers), threading.Semaphore(worker.writers)
        self._drawn = threading.Semaphore(worker.writers + DRAWN_AHEAD)

    def run(self, start: Callable[[], Callable[[tuple[Item, Known | None]], Task]]) -> list[str]:
        """Do the items and return the reasons of failures.

        Args:
            start: loads the resources of all items, and returns the function that makes the task of an item.
        """
        self._manifest.append({"run": self._id, **self._heading, "places": [self._worker.name]})
        began, switch = time.perf_counter(), sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        self._make = start()
        ready = time.perf_counter()
        tqdm.set_lock(threading.RLock())  # its own would be for several processes
        # The bar comes first: a captured stream is no terminal
        with tqdm(total=len(self._plan.todo), desc=self._worker.name, unit="item", disable=None) as self._bar:
            with capturable_streams():
                self._do_all()
        sys.setswitchinterval(switch)
        self._manifest.append({"run": self._id, "ended": now()})
        self._print_summary(ready - began, time.perf_counter() - ready)
        return self._failures

    def _do_all(self) -> None:
        """Run the items; items that may have killed a process before go first, one at a time."""
        for item in self._plan.failed:
            self._end(item, {"status": "failed", "reason": _DIED, "seconds": {}})
        count = self._worker.readers + self._worker.writers + _QUEUED
        todo = iter(self._plan.todo)
        threads, self._drawer = ThreadPoolExecutor(count, "item"), ThreadPoolExecutor(1, "draw")
        try:
            _wait([threads.submit(self._do_some, islice(todo, self._plan.suspects))])
            _wait([threads.submit(self._do_some, todo) for _ in range(count)])
        except BaseException:  # interrupted: no item is to blame
            self._plan.todo.clear()
            for item in tuple(self._in_progress):
                self._append(item, {"status": "stopped"})
            raise
        finally:
            threads.shutdown(wait=False)
            self._drawer.shutdown(wait=False, cancel_futures=True)

    def _do_some(self, todo: Iterator[tuple[Item, Known | None]]) -> None:
        """Run items of `todo` that no other thread takes."""
        for pair in todo:
            progress = _Progress(pair[0])
            self._in_progress.add(pair[0])
            try:
                self._do(progress, pair)
                self._end(pair[0], _record(progress))
                self._bar.update()
            finally:
                self._in_progress.discard(pair[0])

    def _do(self, progress: _Progress, pair: tuple[Item, Known | None]) -> None:
        is_to_draw = False
        with self._readers:
            tries = self._plan.tries.get(progress.item.name, 0) + 1
            self._append(progress.item, {"status": "begun", "tries": tries})
            with self._part("read", progress):
                task = progress.task = self._make(pair)
                is_to_draw = task.read()
        if not is_to_draw:
            return
        self._drawer.submit(self._draw, progress, task).result()
        try:
            if not progress.failure:
                with self._writers, self._part("write", progress):
                    task.write()
        finally:
            self._drawn.release()

    def _draw(self, progress: _Progress, task: Task) -> None:
        self._drawn.acquire()
        with self._part("draw", progress):
            task.draw()

    @contextmanager
    def _part(self, name: str, progress: _Progress) -> Iterator[None]:
        """Time a part, capture its messages, and note the reason of a failure; end the process without a device."""
        began = time.perf_counter()
        try:
            with capture(progress.messages):
                yield
        except (Exception, SystemExit) as error:  # of any kind: other items must not suffer
            progress.failure["reason"] = _reason(error)
            if not isinstance(error, InputError):
                progress.failure["trace"] = traceback.format_exc()
            if _BROKEN_DEVICE in str(error) and not is_out_of_memory(error):
                self._end(progress.item, {"status": "failed", "reason": progress.failure["reason"], "seconds": {}})
                os._exit(EXIT_BROKEN)
        finally:
            progress.seconds[name] = round(time.perf_counter() - began, 4)

    def _end(self, item: Item, record: Record) -> None:
        status = "done" if record["status"] == "kept" else record["status"]
        self._append(item, {**record, "status": status, "where": self._where})
        with self._lock:
            for part, seconds in record["seconds"].items():
                self._seconds[part] += seconds
            if status == "failed":
                self._failures.append(f"{item.input}: {record['reason']}")
            else:
                self._done += 1

    def _append(self, item: Item, record: Record) -> None:
        words = {"options": item.words, "fit_options": item.fit_words}
        first = {"item": item.name, "status": record["status"], "input": item.input, "command": item.command}
        last = {"job": self._plan.jobs[item.name], "run": self._id, "at": now()}
        self._manifest.append({**first, **{name: each for name, each in words.items() if each}, **record, **last})

    def _print_summary(self, start_s: float, seconds: float) -> None:
        """Print the numbers of items, the bound of the run, and the failures."""
        failures, kept, seconds = self._failures, self._plan.kept, max(seconds, 1e-9)
        ended = self._done + len(failures) - len(self._plan.failures)
        total = self._done + len(failures) + kept
        print(f"{self._manifest.folder}: {kept + self._done} of {total} items are done, {kept} of them before")
        threads = {"read": self._worker.readers, "draw": 1, "write": self._worker.writers}
        fractions = {part: self._seconds[part] / (seconds * threads[part]) for part in PARTS}
        parts = "; ".join(
            f"{verb} {self._seconds[part]:.1f} s, {fractions[part]:.0%} of {counted(threads[part], 'thread')}"
            for part, verb in PARTS.items()
        )
        print(
            f"{self._worker.name}: {counted(ended)} in {seconds:.1f} s after {start_s:.1f} s of start, "
            f"{ended / seconds:.3g} a second: {parts}; bound by {PARTS[max(PARTS, key=fractions.__getitem__)]}",
            flush=True,
        )
        lines = failures[:_MOST_LISTED]
        if (more := len(failures) - _MOST_LISTED) > 0:
            lines.append(f"and {more} more")
        for line in lines:
            print(f"failed: {line}", file=sys.stderr)
        if failures:
            again = f"{self._manifest.path} has the reasons, and the same command tries them again"
            print(f"{counted(len(failures))} failed; {again}", file=sys.stderr)


def _wait(threads: list[Future[None]]) -> None:
    """Wait for threads, and raise the first error; in turns, since Ctrl-C does not end a wait on Windows."""
    left = set(threads)
    while left:
        done, left = wait(left, _TURN_S, FIRST_EXCEPTION)
        for thread in done:
            thread.result()


def _record(progress: _Progress) -> Record:
    """Return the entries of an ended item: those of its task, its failure, its messages and times."""
    record: Record = {"status": "done"} | (progress.task.record() if progress.task is not None else {})
    if progress.failure:
        record |= {"status": "failed", **progress.failure}
    return record | {"said": progress.messages + record.get("said", []), "seconds": progress.seconds}


def _reason(error: BaseException) -> str:
    """Return the reason of a failure in one line."""
    words = " ".join(str(error).split())[:1000]
    if isinstance(error, InputError):
        return as_options(words)
    if is_out_of_memory(error):
        return f"out of memory; use a smaller scene or panel, or fewer processes ({words})"
    return f"{type(error).__name__}: {words}"


def now() -> str:
    """Return the time as the manifest writes it."""
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")
