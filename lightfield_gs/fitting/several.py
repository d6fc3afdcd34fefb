"""Several processes that fit one scene together, as torchrun starts them: each has its share of a step's photographs.

All hold the same Gaussians. Gradients are added up over the processes, each sum in the order of their ranks, so that
all get the same bits and take the same step: fields, density and schedules never have to be sent.
"""

from __future__ import annotations

import gc
import hashlib
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

from lightfield_gs.base.errors import InputError

PATIENCE = timedelta(minutes=10)  # how long a process waits for the others; the first one scores and saves meanwhile


def is_first() -> bool:
    """Whether this process is the one that writes files and talks: rank 0 of torchrun, or the only one."""
    return _number("RANK", 0) == 0


class Group:
    """The processes of a fit as one of them sees them. rank: its number; size: how many there are.

    A group of one does nothing. On CUDA the sums and the maximum of tensors can be part of a CUDA graph. Raises
    InputError where the others have ended, or have not answered for PATIENCE.
    """

    def __init__(self, rank: int = 0, size: int = 1):
        self.rank, self.size = rank, size

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that writes files and talks."""
        return self.rank == 0

    def share(self, order: Tensor) -> Tensor:
        """The columns of order [steps,V] that are this process's. Raises InputError where shares would be unequal."""
        views = order.shape[1]
        if views % self.size:
            raise InputError(
                f"{self.size} processes cannot share the {views} photographs of a step equally: expected a multiple of "
                f"{self.size} for batch_size"
            )
        return order[:, self.rank :: self.size].contiguous()

    def sum_(self, tensors: Sequence[Tensor]) -> None:
        """Replaces tensors of one dtype, the same shapes in all processes, by their sums over these.

        Each process adds up a part, in the order of ranks, and sends the sums to the others: as many bytes as for the
        usual reductions, whose order is their own affair.
        """
        if self.size == 1:
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        count = len(flat)
        part = -(-count // self.size)
        flat = torch.cat([flat, flat.new_zeros(part * self.size - count)])
        received = torch.empty_like(flat)
        with self._answers():
            dist.all_to_all_single(received, flat)
        parts = received.view(self.size, part)
        total = parts[0].clone()
        for other in parts[1:]:
            total += other
        with self._answers():
            dist.all_gather_into_tensor(flat, total)
        for tensor, values in zip(tensors, flat[:count].split([t.numel() for t in tensors])):
            tensor.copy_(values.view(tensor.shape))

    def max_(self, tensor: Tensor) -> None:
        """Replaces a tensor by the maximum over the processes, element by element."""
        if self.size > 1:
            with self._answers():
                dist.all_reduce(tensor, dist.ReduceOp.MAX)

    def largest(self, number: int, device: torch.device | str = "cpu") -> int:
        """The largest of a number that each process has; it waits for them. device: the group's own."""
        if self.size == 1:
            return number
        numbers = torch.full((1,), number, dtype=torch.int64, device=device)
        self.max_(numbers)
        return int(numbers)

    def check_same(self, what: str, value: bytes, device: torch.device | str = "cpu") -> None:
        """Raises InputError in all processes unless all have the same value."""
        if self.size == 1:
            return
        digest = int.from_bytes(hashlib.sha256(value).digest()[:7], "big")
        both = torch.tensor([digest, -digest], device=device)
        self.max_(both)
        if int(both.sum()):
            raise InputError(f"the {self.size} processes were given different {what}: expected the same in all")

    @contextmanager
    def _answers(self) -> Iterator[None]:
        """Says what it means when a message to the others fails."""
        try:
            yield
        except (dist.DistError, RuntimeError) as error:
            raise InputError(
                f"process {self.rank} of {self.size}: the others have ended, or not answered for "
                f"{PATIENCE.total_seconds():.0f} s ({' '.join(str(error).split())[:120]})"
            ) from error


ALONE = Group()


@contextmanager
def joined(kind: str) -> Iterator[tuple[Group, str]]:
    """The group of this process, and its own device: alone, or as torchrun's environment variables say.

    kind: cpu or cuda; with CUDA each process of a machine has a GPU of its own. Raises InputError where there are not
    enough of them, and where the processes do not find each other within PATIENCE.
    """
    size, local_rank = _number("WORLD_SIZE", 1), _number("LOCAL_RANK", 0)
    if size == 1:
        yield ALONE, kind
        return
    if kind == "cuda" and local_rank >= torch.cuda.device_count():
        raise InputError(
            f"process {local_rank} of this machine has no GPU of its own, there are {torch.cuda.device_count()}: "
            "start no more processes than that"
        )
    own = torch.device("cuda", local_rank) if kind == "cuda" else None
    if own is not None:
        torch.cuda.set_device(own)
    try:
        dist.init_process_group("gloo" if own is None else "nccl", timeout=PATIENCE, device_id=own)
    except (dist.DistError, RuntimeError, ValueError) as error:
        words = " ".join(str(error).split())[:200]
        raise InputError(f"the {size} processes do not find each other: {words}; start them with torchrun") from error
    try:
        yield Group(dist.get_rank(), size), kind if own is None else f"cuda:{local_rank}"
    finally:
        # Gloo's threads end with the last reference to the group, which a tensor may still hold
        gc.collect()
        dist.destroy_process_group()


def _number(name: str, otherwise: int) -> int:
    """What torchrun says in an environment variable. Raises InputError where that is no number."""
    if "RANK" not in os.environ:
        return otherwise
    text = os.environ.get(name, str(otherwise))
    if not text.isdecimal():
        raise InputError(f"{name}: expected a number in this environment variable, as torchrun sets it, got {text!r}")
    return int(text)
