"""The processes of a run: one, or as many as torchrun starts, each with its share of every batch."""

from __future__ import annotations

import gc
import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor, nn

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError

# The others wait while the first process decodes the data or scores the weights.
_PATIENCE = timedelta(hours=2)


@dataclass(frozen=True)
class Team:
    """The processes of a run as one of them sees them. device: its own. rank: its number. size: how many there are."""

    device: torch.device
    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is the process that logs, saves and scores."""
        return self.rank == 0

    def share(self, count: int) -> slice:
        """This process's part of `count` examples. Raises InputError where equal parts cannot be made."""
        if count % self.size:
            raise InputError(
                f"{self.size} processes cannot share the {count} objects of a step equally: choose a "
                f"multiple of {self.size} for `objects` in every stage, or another number of processes"
            )
        part = count // self.size
        return slice(self.rank * part, (self.rank + 1) * part)

    def replicated(self, net: nn.Module) -> nn.Module:
        """The network whose backward averages gradients over all processes; the same parameters."""
        return net if self.size == 1 else nn.parallel.DistributedDataParallel(net)

    def mean(self, values: Tensor) -> Tensor:
        """The mean of each number over all processes."""
        if self.size > 1:
            dist.all_reduce(values)
            values = values / self.size
        return values

    @contextmanager
    def leader_first(self) -> Iterator[None]:
        """Lets the leader through the block before the others."""
        if self.size > 1 and not self.leads:
            dist.barrier()
        yield
        if self.size > 1 and self.leads:
            dist.barrier()


@contextmanager
def join_team(device: str) -> Iterator[Team]:
    """The team of this process: alone, or as torchrun's environment variables say; one GPU each on CUDA.

    device: cpu, cuda or auto. Nothing that the team has replicated may outlive the block. Raises InputError where there
    are not enough GPUs.
    """
    kind, size = choose_device(device), int(os.environ.get("WORLD_SIZE", 1)) if "RANK" in os.environ else 1
    local_rank = int(os.environ.get("LOCAL_RANK", 0)) if size > 1 else 0
    if kind == "cuda" and local_rank >= torch.cuda.device_count():
        raise InputError(
            f"process number {local_rank} of this machine has no GPU of its own, there are "
            f"{torch.cuda.device_count()}: start no more processes than that"
        )
    if kind == "cuda":
        torch.cuda.set_device(local_rank)
        # What is not bfloat16 is float32: the heads place Gaussians to fractions of a pixel.
        torch.backends.cudnn.allow_tf32 = False
    own = torch.device(kind, local_rank) if kind == "cuda" else torch.device("cpu")
    if size == 1:
        yield Team(own)
        return
    # Before there is a group: DDP imports this module, whose functions keep the one that they find as a default.
    importlib.import_module("torch.distributed.nn")
    dist.init_process_group(
        "nccl" if kind == "cuda" else "gloo", timeout=_PATIENCE, device_id=own if kind == "cuda" else None
    )
    try:
        yield Team(own, dist.get_rank(), size)
    finally:
        # Gloo's threads end with the last reference to the group; one that has a tensor of Python's left to let go of
        # when the interpreter ends aborts the process.
        gc.collect()
        dist.destroy_process_group()
