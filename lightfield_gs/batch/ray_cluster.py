"""The processes of a batch on a Ray cluster: its actors, one for each GPU or for a few cores."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

from lightfield_gs.base.cli_messages import make_streams_capturable
from lightfield_gs.base.errors import InputError
from lightfield_gs.batch.dispatch import Event
from lightfield_gs.batch.pipeline import Pipeline
from lightfield_gs.batch.places import CORES_A_PROCESS, on_a_gpu, on_cpu, threads_beside
from lightfield_gs.batch.worker import Job, Place, where


class Worker:
    """What an actor is: a pipeline, one call of `do` for each item that is on its way."""

    def __init__(self, job: Job, place: Place) -> None:
        began = time.perf_counter()
        make_streams_capturable()
        self._place, self._ended = place, dict[int, Future[dict[str, Any]]]()
        self._pipeline = Pipeline(
            job.start(place),
            place.readers,
            place.writers,
            lambda number: None,
            lambda number, record: self._ended.pop(number).set_result(record),
            lambda number, reason: os._exit(1),
        )
        self._seconds = time.perf_counter() - began

    def ready(self) -> float:
        """The seconds that it took to begin."""
        return self._seconds

    def do(self, number: int, item: Any) -> dict[str, Any]:
        """How an item ended, once it has."""
        ended = self._ended[number] = Future()
        self._pipeline.submit(number, item)
        return ended.result() | {"where": where(self._place)}


class RayCluster:
    """Actors on a cluster, that are started anew where they die. Use it in a `with`.

    address: of the cluster; "local": one of this machine that ends with the program. devices: "cpu", or None for the
    cluster's GPUs where it has any. processes, threads, have_gpus: see places_here. most: processes at most. Raises
    InputError.
    """

    def __init__(
        self,
        address: str,
        job: Job,
        devices: str | None,
        processes: int | None,
        threads: int | None,
        have_gpus: bool,
        most: int,
    ):
        if devices not in (None, "cpu"):
            raise InputError(f"--devices: Ray places its processes itself; expected cpu or none, got {devices}")
        try:
            import ray
        except ImportError as error:
            raise InputError(f"--ray needs the package ray ({error}): pip install 'lightfield-gs[ray]'") from None
        self._ray, self._job = ray, job
        try:
            ray.init(address, log_to_driver=False, configure_logging=False)
            found = ray.cluster_resources()
        except (ConnectionError, ValueError, RuntimeError, OSError) as error:
            raise InputError(f"--ray {address}: {' '.join(str(error).split())[:300]}") from None
        gpus = 0 if devices == "cpu" else int(found.get("GPU", 0))
        self._need, place, count = _shares(gpus, int(found.get("CPU", 1)), processes, threads, have_gpus)
        self.places = [replace(place, name=f"{place.device}:{number}") for number in range(min(count, most))]
        self._actors: list[Any] = []
        self._pending: dict[Any, tuple[int, int | None]] = {}  # of each call: its actor, and its item

    def __enter__(self) -> RayCluster:
        self._actors = [None] * len(self.places)
        for worker in range(len(self.places)):
            self._start(worker)
        return self

    def __exit__(self, *_: object) -> None:
        for actor in self._actors:
            self._ray.kill(actor)
        self._ray.shutdown()

    def send(self, worker: int, number: int, item: Any) -> None:
        """Hands an item to an actor."""
        self._pending[self._actors[worker].do.remote(number, item)] = worker, number

    def events(self, timeout: float) -> Iterator[Event]:
        """What the actors tell, after `timeout` seconds at the latest."""
        pending = list(self._pending)
        ended, _ = self._ray.wait(pending, num_returns=1, timeout=timeout)
        for call in ended:
            worker, number = self._pending.pop(call)
            try:
                value = self._ray.get(call)
            except self._ray.exceptions.RayActorError as error:
                yield self._died(worker, error)
            except self._ray.exceptions.RayTaskError as error:
                yield Event("unfit", worker, reason=f"{' '.join(str(error.cause).split())[:300]}")
            else:
                is_ready = number is None
                yield Event("ready", worker, seconds=value) if is_ready else Event("done", worker, number, value)

    def _died(self, worker: int, error: Exception) -> Event:
        """Forgets the calls of an actor that is gone, and starts another."""
        self._pending = {call: pair for call, pair in self._pending.items() if pair[0] != worker}
        self._start(worker)
        return Event("died", worker, reason=f"the process died of it ({' '.join(str(error).split())[:200]})")

    def _start(self, worker: int) -> None:
        place = self.places[worker]
        actor = self._ray.remote(**self._need, max_concurrency=place.room + 1)(Worker).remote(self._job, place)
        self._actors[worker] = actor
        self._pending[actor.ready.remote()] = worker, None


def _shares(
    gpus: int, cpus: int, processes: int | None, threads: int | None, have_gpus: bool
) -> tuple[dict[str, float], Place, int]:
    """What of the cluster each process needs, a place, and how many there are."""
    if gpus:
        count = processes or gpus * on_a_gpu(cpus // gpus, have_gpus)
        share = max(1, cpus // max(count, gpus))
        place = Place("", "cuda", None, (), threads or share, *threads_beside(share))
        return {"num_gpus": min(1.0, gpus / count), "num_cpus": 0}, place, count
    each = threads or (max(1, cpus // processes) if processes else min(CORES_A_PROCESS, cpus))
    return {"num_cpus": min(each, cpus)}, on_cpu("", (), each), processes or max(1, cpus // each)
