"""One run of a batch in one process: items go through the pipeline, and their ends into the manifest."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import Any

from tqdm import tqdm

from lightfield_gs.base.checks import counted
from lightfield_gs.base.cli_messages import capturable_streams
from lightfield_gs.batch.items import Item
from lightfield_gs.batch.manifest import Manifest, Plan, Record
from lightfield_gs.batch.pipeline import PARTS, Pipeline, Task

EXIT_BROKEN = 70  # of a process whose device cannot be used any more
_SWITCH_S = 2e-4  # between threads of Python: the drawing thread must not wait long for readers and writers
_QUEUED = 4  # items on their way beyond one for each thread
_DIED = "the process died of it"
_MOST_LISTED = 100  # failures, at the end
_VERBS = {"read": "reading", "draw": "drawing", "write": "writing"}


@dataclass(frozen=True)
class Worker:
    """The resources of a process.

    Attributes:
        name: for people, such as "cuda:0 process 1".
        device: cpu or cuda.
        visible: CUDA_VISIBLE_DEVICES of the process; None to leave it.
        threads: that draw on the CPU.
        readers, writers: number of threads beside the drawing thread.
    """

    name: str
    device: str
    visible: str | None = None
    threads: int = 1
    readers: int = 1
    writers: int = 1


@dataclass
class _Tally:
    done: int = 0
    failures: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))


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
        self._tally, self._on_way = _Tally(failures=list(plan.failures)), set[int]()
        self._change = threading.Condition()  # of the two
        self._most = worker.readers + worker.writers + _QUEUED

    def run(self, start: Callable[[], Callable[[Any], Task]]) -> list[str]:
        """Do the items and return the reasons of failures.

        Args:
            start: loads what all items need, and returns the function that makes the task of an item.
        """
        self._manifest.append({"run": self._id, **self._heading, "places": [self._worker.name]})
        began, switch, plan = time.perf_counter(), sys.getswitchinterval(), self._plan
        sys.setswitchinterval(_SWITCH_S)
        make = start()
        ready = time.perf_counter()
        tqdm.set_lock(threading.RLock())  # its own would be for several processes
        # The bar comes first: a stream that is captured is no terminal
        with tqdm(total=len(plan.todo), desc=self._worker.name, unit="item", disable=None) as self._bar:
            with capturable_streams():
                pipeline = Pipeline(
                    make, self._worker.readers, self._worker.writers, self._on_begin, self._on_end, self._on_broken
                )
                try:
                    for item in plan.failed:
                        self._end(item, {"status": "failed", "reason": _DIED, "seconds": {}})
                    self._submit_all(pipeline)
                    self._wait_for(0)
                except BaseException:  # interrupted: no item is to blame
                    for number in tuple(self._on_way):
                        self._append(plan.todo[number][0], {"status": "stopped"})
                    pipeline.close(wait=False)
                    raise
                pipeline.close()
        sys.setswitchinterval(switch)
        self._manifest.append({"run": self._id, "ended": now()})
        self._print_summary(ready - began, time.perf_counter() - ready)
        return self._tally.failures

    def _submit_all(self, pipeline: Pipeline) -> None:
        """Submit items to free threads; items that may have killed a process before go first, one at a time."""
        for number, pair in enumerate(self._plan.todo):
            self._wait_for(self._most - 1)
            with self._change:
                self._on_way.add(number)
            pipeline.submit(number, pair)
            if number < self._plan.suspects:
                self._wait_for(0)

    def _wait_for(self, count: int) -> None:
        """Wait until at most `count` items are on their way."""
        with self._change:
            self._change.wait_for(lambda: len(self._on_way) <= count)

    def _on_begin(self, number: int) -> None:
        item = self._plan.todo[number][0]
        self._append(item, {"status": "begun", "tries": self._plan.tries.get(item.name, 0) + 1})

    def _on_end(self, number: int, record: Record) -> None:
        try:
            self._end(self._plan.todo[number][0], record)
            self._bar.update()
        finally:
            with self._change:
                self._on_way.discard(number)
                self._change.notify()

    def _on_broken(self, number: int, reason: str) -> None:
        self._end(self._plan.todo[number][0], {"status": "failed", "reason": reason, "seconds": {}})
        os._exit(EXIT_BROKEN)

    def _end(self, item: Item, record: Record) -> None:
        status = "done" if record["status"] == "kept" else record["status"]
        self._append(item, {**record, "status": status, "where": self._where})
        with self._change:
            for part, seconds in record["seconds"].items():
                self._tally.seconds[part] += seconds
            if status == "failed":
                self._tally.failures.append(f"{item.input}: {record['reason']}")
            else:
                self._tally.done += 1

    def _append(self, item: Item, record: Record) -> None:
        words: Record = {"options": item.words} if item.words else {}
        if item.fit_words:
            words["fit_options"] = item.fit_words
        first = {"item": item.name, "status": record["status"], "input": item.input, "command": item.command}
        last = {"job": self._plan.jobs[item.name], "run": self._id, "at": now()}
        self._manifest.append({**first, **words, **record, **last})

    def _print_summary(self, start_s: float, seconds: float) -> None:
        """Print the numbers of items, the bound of the run, and the failures."""
        tally, kept = self._tally, self._plan.kept
        ended = tally.done + len(tally.failures) - len(self._plan.failures)
        total = tally.done + len(tally.failures) + kept
        print(f"{self._manifest.folder}: {kept + tally.done} of {total} items are done, {kept} of them before")
        threads = {"read": self._worker.readers, "draw": 1, "write": self._worker.writers}
        fractions = {part: tally.seconds[part] / (max(seconds, 1e-9) * threads[part]) for part in PARTS}
        parts = "; ".join(
            f"{_VERBS[part]} {tally.seconds[part]:.1f} s, {fractions[part]:.0%} of {counted(threads[part], 'thread')}"
            for part in PARTS
        )
        bound = _VERBS[max(PARTS, key=lambda part: fractions[part])]
        print(
            f"{self._worker.name}: {counted(ended)} in {seconds:.1f} s after {start_s:.1f} s of start, "
            f"{ended / max(seconds, 1e-9):.3g} a second: {parts}; bound by {bound}",
            flush=True,
        )
        for words in tally.failures[:_MOST_LISTED]:
            print(f"failed: {words}", file=sys.stderr)
        if (more := len(tally.failures) - _MOST_LISTED) > 0:
            print(f"failed: and {more} more", file=sys.stderr)
        if tally.failures:
            print(
                f"{counted(len(tally.failures))} failed; {self._manifest.path} has the reasons, and the same command "
                "tries them again",
                file=sys.stderr,
            )


def now() -> str:
    """Return the time as the manifest writes it."""
    return datetime.now(timezone.utc).isoformat(timespec="milliseconds")
