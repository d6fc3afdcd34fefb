"""The training command; writes at its end which threads of Gloo still run, since those may abort a process that ends.

First argument: PATH; each process writes PATH-RANK. What several processes print would mix, within lines too."""
import os
import sys
from pathlib import Path

from training.train import main

code = main(sys.argv[2:])
names = [task.read_text().strip() for task in Path("/proc/self/task").glob("*/comm")]
Path(f"{sys.argv[1]}-{os.environ.get('RANK', 0)}").write_text(" ".join(name for name in names if "gloo" in name))
sys.exit(code)
