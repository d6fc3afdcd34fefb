"""Training by one process, or by several that torchrun starts, each with its part of every batch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor, nn

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.torchrun import join_processes

# The others wait while the first process decodes the data or scores the weights.
_PATIENCE = timedelta(hours=2)


@dataclass(frozen=True)
class Team:
    """The processes of a run as one of them sees them: its device, its rank, and their number."""

    device: torch.device
    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process logs, saves and scores."""
        return self.rank == 0

    def split(self, count: int) -> slice:
        """Return this process's part of `count` examples; raise InputError unless all parts are equal."""
        if count % self.size:
            raise InputError(
                f"{self.size} processes cannot share the {count} objects of a step equally: choose a "
                f"multiple of {self.size} for `objects` in every stage, or another number of processes"
            )
        part = count // self.size
        return slice(self.rank * part, (self.rank + 1) * part)

    def replicated(self, net: nn.Module) -> nn.Module:
        """Return the network with a backward pass that averages gradients over all processes; it shares parameters."""
        return net if self.size == 1 else nn.parallel.DistributedDataParallel(net)

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of each number over all processes."""
        if self.size > 1:
            dist.all_reduce(values)
            values = values / self.size
        return values

    @contextmanager
    def leader_first(self) -> Iterator[None]:
        """Let the leader through the block before the others."""
        if self.size > 1 and not self.leads:
            dist.barrier()
        yield
        if self.size > 1 and self.leads:
            dist.barrier()


@contextmanager
def join_team(device: str) -> Iterator[Team]:
    """Join the processes of a run, one GPU each on CUDA; see base.torchrun.join_processes.

    Nothing that the team has replicated may outlive the block.

    Args:
        device: cpu, cuda or auto.

    Raises:
        InputError: there are too few GPUs.
    """
    kind = choose_device(device)
    with join_processes(kind, _PATIENCE) as (rank, size, own):
        if own.type == "cuda":
            own = torch.device("cuda", own.index or 0)
            torch.cuda.set_device(own)
            # Sums that are not bfloat16 are float32: the heads place Gaussians to fractions of a pixel
            torch.backends.cudnn.allow_tf32 = False
        yield Team(own, rank, size)
