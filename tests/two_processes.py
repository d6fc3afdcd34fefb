"""Two processes of one program, in a group."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path


def printed_by_two(program: Path, *arguments: str) -> list[tuple[int, str]]:
    """Exit code and output of two processes that find each other by torchrun's environment variables."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    common = {"OMP_NUM_THREADS": "1", "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    streams = dict(stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    running = [
        subprocess.Popen(
            [sys.executable, program, *arguments],
            env=os.environ | common | {"RANK": rank, "LOCAL_RANK": rank},
            **streams,
        )
        for rank in "01"
    ]
    printed = [process.communicate(timeout=120)[0] for process in running]
    return [(process.returncode, words) for process, words in zip(running, printed)]
