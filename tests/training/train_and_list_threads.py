"""The training command; writes at its end which threads of Gloo still run, since those may abort a process that ends.

First argument: PATH; each process writes PATH-RANK. What several processes print would mix, within lines too."""

import os
import sys
import time
from pathlib import Path

from training.train import main


def threads_of_gloo() -> list[str]:
    """Names of those that run now."""
    names = []
    for task in Path("/proc/self/task").iterdir():
        try:
            names.append((task / "comm").read_text().strip())
        except (FileNotFoundError, ProcessLookupError):  # it has just ended
            pass
    return [name for name in names if "gloo" in name]


code = main(sys.argv[2:])
for _ in range(100):  # the system lists a thread for a moment after it was joined
    if not threads_of_gloo():
        break
    time.sleep(0.01)
Path(f"{sys.argv[1]}-{os.environ.get('RANK', 0)}").write_text(" ".join(threads_of_gloo()))
sys.exit(code)
