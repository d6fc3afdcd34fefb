"""Items that take no time, for the processes of a batch: each does what its name says."""

import os
import signal
import time
from functools import partial
from pathlib import Path

from lightfield_gs.batch.items import Item
from lightfield_gs.batch.manifest import Manifest, make_plan
from lightfield_gs.batch.run import Run


def run_shard(options, shard, worker) -> int:
    """Do the items options["names"] in the folder options["folder"], as `lightfield-gs batch` does its own."""
    items = [Item(name, name) for name in options["names"]][shard[0] - 1 :: shard[1]]
    with Manifest(options["folder"], shard) as manifest:
        plan = make_plan(items, manifest, {"all": {}}, since=options["since"])
        return int(bool(Run(plan, manifest, worker, {}).run(partial(load, options))))


def load(options):
    if options.get("unfit"):
        from lightfield_gs import InputError

        raise InputError(options["unfit"])
    return lambda pair: _Task(pair[0].name, Path(options["folder"]))


class _Task:
    def __init__(self, name, folder):
        self.name, self.folder = name, folder

    def read(self):
        print(f"reads {self.name}")
        with open(self.folder / self.name, "a") as file:
            file.write("x")  # one for each time it was begun
        return self._does("read")

    def draw(self):
        self._does("draw")

    def write(self):
        self._does("write")

    def record(self):
        return {"status": "done", "process": os.getpid(), "inputs": {}, "outputs": {}}

    def _does(self, part):
        if self.name == f"dies-in-{part}":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.name == f"fails-in-{part}":
            raise ZeroDivisionError("as its name\nsays")
        if self.name == f"breaks-in-{part}":
            raise RuntimeError("CUDA error: an illegal memory access was encountered")
        if self.name == "exits":
            raise SystemExit(3)
        time.sleep(30 if self.name.startswith("long") else 0.01)
        return self.name != "kept"
