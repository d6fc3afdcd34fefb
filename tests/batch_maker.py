"""Items that take no time, for the processes of a batch: each does what its name says."""

import os
import signal
import time
from pathlib import Path


def maker(options, place):
    if options.get("unfit"):
        from lightfield_gs import InputError

        raise InputError(options["unfit"])
    return lambda pair: _Task(pair[0].name, Path(options["folder"]))


class _Task:
    def __init__(self, name, folder):
        self.name, self.folder = name, folder
        self.part = "read"

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
        return {"status": "done", "process": os.getpid()}

    def _does(self, part):
        if self.name == f"dies-in-{part}":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.name == f"fails-in-{part}":
            raise ZeroDivisionError("as its name\nsays")
        if self.name == f"breaks-in-{part}":
            raise RuntimeError("CUDA error: an illegal memory access was encountered")
        if self.name == "exits":
            raise SystemExit(3)
        time.sleep(0.01)
        return self.name != "kept"
