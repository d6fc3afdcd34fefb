"""A fit by several processes, which torchrun starts: each draws its part of a step's photographs.

All have the same Gaussians. Gradients are summed over the processes in the order of their ranks, so that all get the
same bits and take the same step. Parameters, density and schedules never have to be sent.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Literal

import torch
import torch.distributed as dist
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.torchrun import join_processes

PATIENCE = timedelta(minutes=10)  # how long a process waits for the others; the first one scores and saves meanwhile


class Group:
    """The group of processes of a fit, seen from one process; a group of one does nothing.

    On CUDA the sums and the maximum of tensors can be part of a CUDA graph. All methods raise InputError where the
    others have ended, or have not answered for PATIENCE.
    """

    def __init__(self, rank: int = 0, size: int = 1):
        self.rank, self.size = rank, size

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and prints."""
        return self.rank == 0

    def split(self, order: Tensor) -> Tensor:
        """Return this process's columns of order [steps,V]; raise InputError if the processes' numbers differ."""
        batch_size = order.shape[1]
        if batch_size % self.size:
            raise InputError(
                f"{self.size} processes cannot share the {batch_size} photographs of a step equally: expected a "
                f"multiple of {self.size} for batch_size"
            )
        return order[:, self.rank :: self.size].contiguous()

    def sum_(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors of one dtype, with the same shapes in all processes, by their sums over the processes.

        Each process sums a part in the order of ranks, and sends it to the others. The usual reductions send the same
        number of bytes, but their order is not fixed.
        """
        if self.size == 1:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        count = len(flat)
        part = -(-count // self.size)
        flat = torch.cat([flat, flat.new_zeros(part * self.size - count)])
        received = torch.empty_like(flat)
        with self._explain_failure():
            dist.all_to_all_single(received, flat)
        parts = received.view(self.size, part)
        total = parts[0].clone()
        for other in parts[1:]:
            total += other
        with self._explain_failure():
            dist.all_gather_into_tensor(flat, total)
        for tensor, values in zip(tensors, flat[:count].split([t.numel() for t in tensors])):
            tensor.copy_(values.view(tensor.shape))

    def max_(self, tensor: Tensor) -> None:
        """Replace a tensor by its element-wise maximum over the processes."""
        if self.size > 1:
            with self._explain_failure():
                dist.all_reduce(tensor, dist.ReduceOp.MAX)

    def largest(self, number: int, device: torch.device | str = "cpu") -> int:
        """Wait for all processes and return the largest of their numbers.

        Args:
            device: Device of the group.
        """
        if self.size == 1:
            return number
        numbers = torch.full((1,), number, dtype=torch.int64, device=device)
        self.max_(numbers)
        return int(numbers)

    def check_same(self, what: str, value: bytes, device: torch.device | str = "cpu") -> None:
        """Raise InputError in all processes unless all have the same value."""
        if self.size == 1:
            return
        digest = int.from_bytes(hashlib.sha256(value).digest()[:7], "big")
        both = torch.tensor([digest, -digest], device=device)
        self.max_(both)
        if int(both.sum()):
            raise InputError(f"the {self.size} processes were given different {what}: expected the same in all")

    @contextmanager
    def _explain_failure(self) -> Iterator[None]:
        """Raise InputError where a message to the others fails."""
        try:
            yield
        except (dist.DistError, RuntimeError) as error:
            raise InputError(
                f"process {self.rank} of {self.size}: the others have ended, or not answered for "
                f"{PATIENCE.total_seconds():.0f} s ({' '.join(str(error).split())[:120]})"
            ) from error


ALONE = Group()


@contextmanager
def join_group(kind: Literal["cpu", "cuda"]) -> Iterator[tuple[Group, str]]:
    """Join the processes of a fit; yield the group and this process's device. See base.torchrun.join_processes."""
    with join_processes(kind, PATIENCE) as (rank, size, device):
        yield ALONE if size == 1 else Group(rank, size), str(device)
