"""The processes of a batch on this machine."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from lightfield_gs.batch.dispatch import Event
from lightfield_gs.batch.worker import Job, Place, serve

_PATIENCE_S = 5.0  # for a process that is about to end


class Processes:
    """One process for each place; those that die are started anew. Use it in a `with`, which ends them all."""

    def __init__(self, job: Job, places: Sequence[Place]):
        self.places, self._job = list(places), job
        self._context = multiprocessing.get_context("spawn")  # a fork would take along a device that is in use
        self._running: list[tuple[SpawnProcess, Connection]] = []
        self._blamed: dict[int, tuple[int, str]] = {}

    def __enter__(self) -> Processes:
        try:
            self._running = [self._start(place) for place in self.places]
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def send(self, worker: int, number: int, item: Any) -> None:
        """Hands an item to a process; one that has died tells so itself."""
        try:
            self._running[worker][1].send((number, item))
        except OSError:
            pass

    def events(self, timeout: float) -> Iterator[Event]:
        """What the processes tell, after `timeout` seconds at the latest."""
        ready = wait([connection for _, connection in self._running], timeout)
        for worker, (_, connection) in enumerate(self._running):
            if connection in ready:
                yield self._heard(worker, connection)

    def _heard(self, worker: int, connection: Connection) -> Event:
        try:
            kind, *rest = connection.recv()
        except (EOFError, OSError):
            return self._died(worker)
        if kind == "broken":
            self._blamed[worker] = rest[0], rest[1]
            return self._died(worker)
        if kind == "ready":
            return Event(kind, worker, seconds=rest[0])
        if kind == "unfit":
            return Event(kind, worker, reason=rest[0])
        return Event(kind, worker, rest[0], rest[1] if kind == "done" else None)

    def _died(self, worker: int) -> Event:
        process, connection = self._running[worker]
        connection.close()
        process.join(_PATIENCE_S)  # for its own exit code
        process.kill()
        process.join()
        code = process.exitcode
        number, reason = self._blamed.pop(worker, (None, ""))
        self._running[worker] = self._start(self.places[worker])
        how = f"signal {-code}" if code is not None and code < 0 else f"exit code {code}"
        return Event("died", worker, number, reason=reason or f"the process died of it ({how})")

    def _start(self, place: Place) -> tuple[SpawnProcess, Connection]:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=serve, args=(theirs, self._job, place), name=place.name)
        with _visible(place.visible):
            process.start()
        theirs.close()
        return process, ours

    def _end(self) -> None:
        for process, connection in self._running:
            connection.close()
            process.kill()  # what it has not told yet is done again the next time
            process.join()
        self._running = []


@contextmanager
def _visible(devices: str | None) -> Iterator[None]:
    """Which GPUs a process sees that is started meanwhile; None: all."""
    if devices is None:
        yield
        return
    name = "CUDA_VISIBLE_DEVICES"
    before = os.environ.get(name)
    os.environ[name] = devices
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
