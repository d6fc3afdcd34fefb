"""Operations in a row made one kernel, where a run asks for it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeVar, cast

import torch

Function = TypeVar("Function", bound=Callable)


def fused(function: Function, wanted: bool, dynamic: bool = False) -> Function:
    """A function of the module's own, if wanted as torch.compile makes it.

    Args:
        dynamic: Make it once for all shapes, not for each set of shapes that it meets.
    """
    return cast(Function, _compiled(function, dynamic)) if wanted else function


def keep_compile_workers() -> None:
    """Let the processes of torch.compile that make kernels wait for work however long it takes.

    torch 2.11 ends them after 60 seconds without work, which the tracing of a network can take. On an H100 a training
    run then waited for them for ever.
    """
    from torch._inductor import config

    if hasattr(config, "quiesce_async_compile_pool"):
        config.quiesce_async_compile_pool = False


def keep_one_graph() -> None:
    """Let torch.compile make one graph of a network that several processes train, as of a network that one trains.

    By default it cuts the graph where a bucket of gradients ends. Our networks are smaller than two buckets: the cut
    would save nothing, and the kernels that one process left in the cache would not serve several.
    """
    from torch import _dynamo

    _dynamo.config.optimize_ddp = False


@cache
def _compiled(function: Callable, dynamic: bool) -> Callable:
    keep_compile_workers()
    return torch.compile(function, dynamic=dynamic)
