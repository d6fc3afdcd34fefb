"""The processes that torchrun starts: which one this is, its GPU, and the group of all."""

from __future__ import annotations

import gc
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import Literal, NamedTuple

import torch
import torch.distributed as dist

from lightfield_gs.base.errors import InputError


class Member(NamedTuple):
    """One process of a group."""

    rank: int
    size: int  # of the group; 1 without torchrun
    device: torch.device


def is_first() -> bool:
    """Return whether this process has rank 0, or is the only one: it alone writes files and prints."""
    return _environment("RANK", 0) == 0


def see_own_gpu() -> None:
    """Hide the other GPUs from this process of torchrun, before anything asks CUDA: its own is number 0 then.

    Compiled kernels name their GPU by number, so one compilation serves all processes. Where there are fewer GPUs than
    processes nothing is hidden, and join_processes says so.
    """
    if _environment("WORLD_SIZE", 1) == 1:
        return
    rank, visible = _environment("LOCAL_RANK", 0), os.environ.get("CUDA_VISIBLE_DEVICES")
    gpus = [str(number) for number in range(torch.cuda.device_count())] if visible is None else visible.split(",")
    if rank < len(gpus):
        os.environ.update(CUDA_VISIBLE_DEVICES=gpus[rank], LOCAL_RANK="0")


@contextmanager
def join_processes(kind: Literal["cpu", "cuda"], timeout: timedelta) -> Iterator[Member]:
    """Join the processes that torchrun started for the time of the block; without torchrun there is one.

    With CUDA each process of a machine has a GPU of its own. No tensor that the group has sent may outlive the block.

    Args:
        kind: the device.
        timeout: how long processes wait for each other.

    Raises:
        InputError: there are too few GPUs, or the processes do not find each other.
    """
    size, local_rank = _environment("WORLD_SIZE", 1), _environment("LOCAL_RANK", 0)
    if size == 1:
        yield Member(0, 1, torch.device(kind))
        return
    if kind == "cuda" and local_rank >= torch.cuda.device_count():
        raise InputError(
            f"process {local_rank} of this machine has no GPU of its own, there are {torch.cuda.device_count()}: "
            "start no more processes than that"
        )
    gpu = torch.device("cuda", local_rank) if kind == "cuda" else None
    if gpu is not None:
        torch.cuda.set_device(gpu)
    # Before there is a group: DDP imports this module, whose functions keep the present group as a default
    importlib.import_module("torch.distributed.nn")
    try:
        dist.init_process_group("gloo" if gpu is None else "nccl", timeout=timeout, device_id=gpu)
    except (dist.DistError, RuntimeError, ValueError) as error:
        words = " ".join(str(error).split())[:200]
        raise InputError(f"the {size} processes do not find each other: {words}; start them with torchrun") from error
    try:
        yield Member(dist.get_rank(), size, gpu or torch.device("cpu"))
    finally:
        # Gloo's threads end with the last reference to the group. If a tensor still holds one when the interpreter
        # ends, the process aborts.
        gc.collect()
        dist.destroy_process_group()


def _environment(name: str, otherwise: int) -> int:
    """Return an environment variable of torchrun; raise InputError where it is not a number."""
    if "RANK" not in os.environ:
        return otherwise
    text = os.environ.get(name, str(otherwise))
    if not text.isdecimal():
        raise InputError(f"{name}: expected a number in this environment variable, as torchrun sets it, got {text!r}")
    return int(text)
