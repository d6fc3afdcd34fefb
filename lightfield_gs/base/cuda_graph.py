"""Launches on a CUDA device that are repeated as they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

_WARM_UP = 2  # calls before a capture, in which libraries load and choose their algorithms


def captured(call: Callable[[], Any]) -> tuple[torch.cuda.CUDAGraph, Any]:
    """The launches of a call as a graph, and what the call returned, which every replay writes over.

    The graph is replayed once here: a capture computes nothing, and the calls that are captured next read the result
    when they warm up. Other threads may use the device meanwhile.
    """
    beside = torch.cuda.Stream()
    beside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(beside):
        for _ in range(_WARM_UP):
            call()
    torch.cuda.current_stream().wait_stream(beside)
    graph = torch.cuda.CUDAGraph()
    # A stream of its own, for torch's belongs to the device that captured first
    with torch.cuda.graph(graph, stream=beside, capture_error_mode="thread_local"):
        result = call()
    graph.replay()
    return graph, result
