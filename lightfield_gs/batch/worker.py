"""A process of a batch: it takes items from its parent, and ends with it."""

from __future__ import annotations

import importlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from lightfield_gs.base.cli_messages import make_streams_capturable
from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.pipeline import Pipeline, Task

_SWITCH_S = 2e-4  # after which a thread lets others run: the one that draws must not wait for those that read and write
_BROKEN = 70  # the exit code of a process whose device cannot be used any more


@dataclass(frozen=True)
class Place:
    """Where a process works. name: in words. device: cpu or cuda, the one that `visible` leaves to be seen. cores: that
    it keeps to; () for all. threads: of drawing. readers, writers: threads."""

    name: str
    device: str
    visible: str | None = None
    cores: tuple[int, ...] = ()
    threads: int = 1
    readers: int = 1
    writers: int = 1

    @property
    def room(self) -> int:
        """Items on their way at a time, so that each thread has one and some wait."""
        return self.readers + self.writers + 4


@dataclass(frozen=True)
class Job:
    """What makes tasks of items in each process. maker: "module:function", called with `options` and the place; what it
    returns makes a task of an item. Both can be pickled."""

    maker: str
    options: dict[str, Any] = field(default_factory=dict)

    def start(self, place: Place) -> Callable[[Any], Task]:
        """Loads what all items need. Raises InputError."""
        module, name = self.maker.split(":")
        return getattr(importlib.import_module(module), name)(self.options, place)


def serve(connection: Connection, job: Job, place: Place) -> None:
    """Takes (number, item) after the other and tells of each, until the parent is gone or ends it: then at once, for
    nobody would note what it does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's, which ends this one
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    began = time.perf_counter()
    if place.cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, place.cores)
    make_streams_capturable()
    sys.setswitchinterval(_SWITCH_S)
    lock = threading.Lock()

    def tell(*message: Any) -> None:
        try:
            with lock:
                connection.send(message)
        except OSError:
            os._exit(1)

    def broken(number: int, reason: str) -> None:
        tell("broken", number, reason)
        os._exit(_BROKEN)

    try:
        make = job.start(place)
    except InputError as error:
        tell("unfit", str(error))
        return
    pipeline = Pipeline(
        make,
        place.readers,
        place.writers,
        lambda number: tell("began", number),
        lambda number, record: tell("done", number, record | {"where": where(place)}),
        broken,
    )
    tell("ready", time.perf_counter() - began)
    while True:
        try:
            message = connection.recv()
        except (EOFError, OSError):
            os._exit(1)
        pipeline.submit(*message)


def where(place: Place) -> str:
    """The machine and the place on it."""
    return f"{socket.gethostname()} {place.name}"
