"""The Gaussians that cameras see, taken from all, or from the parts that the processes of a group hold.

Processes send parameters, not splats: each Gaussian once to each process whose cameras see it. So every option of
`render` holds, and gradients to a camera stay with the process that owns it.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from lightfield_gs.base.errors import InputError


def check_group() -> None:
    """Raise InputError unless this process is one of a group."""
    if not (dist.is_available() and dist.is_initialized()):
        raise InputError(
            "distributed: expected a group of processes, got none: start them with torchrun, and call "
            "torch.distributed.init_process_group first"
        )


def gather_from_all(tensor: Tensor) -> Tensor:
    """Return the tensors [C, ...] of all processes, one after the other in the order of ranks; no gradients."""
    own = tensor.detach().contiguous()
    every = [torch.empty_like(own) for _ in range(dist.get_world_size())]
    dist.all_gather(every, own)
    return torch.cat(every)


def check_same(facts: dict[str, int], device: torch.device) -> None:
    """Raise InputError in all processes unless all have the same facts."""
    mine = torch.tensor([list(facts.values())], device=device)
    for rank, other in enumerate(gather_from_all(mine).tolist()):
        if other != mine[0].tolist():
            theirs = dict(zip(facts, other))
            raise InputError(
                f"distributed: expected the same in all processes, got {facts} in process {dist.get_rank()} and "
                f"{theirs} in process {rank}"
            )


class SeenRows:
    """The rows of Gaussians that cameras see: of this process alone, or of a group whose processes hold a part each.

    Attributes:
        rows: [S] numbers of this process's Gaussians, first those for process 0, then those for process 1 and so on.
        owners: [S], for which process each is.
    """

    def __init__(self, seen: Tensor, distributed: bool) -> None:
        """Find the rows.

        Args:
            seen: [P, N] bool, which Gaussians the cameras of each process see.
            distributed: whether there is a group of P processes; else P is 1.
        """
        self.owners, self.rows = seen.nonzero().unbind(-1)
        self._counts: tuple[list[int], list[int]] | None = None
        if distributed:
            sent = seen.sum(1)
            received = torch.empty_like(sent)
            dist.all_to_all_single(received, sent)
            self._counts = sent.tolist(), received.tolist()

    def take(self, tensor: Tensor, sparse: bool) -> Tensor:
        """Return the rows [S, ...] of a tensor [N, ...]; sparse: its gradient has these rows alone."""
        return _TakenRows.apply(tensor, self.rows) if sparse else tensor[self.rows]

    def exchange(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """Send rows to the processes that draw them, and return those that came, in the order of ranks.

        Args:
            tensors: [S, ...] of one dtype, with the same names and shapes of a row in all processes.

        Raises:
            InputError: rows differ in their lengths.
        """
        if self._counts is None:
            return tensors
        widths = [tensor.shape[1:].numel() for tensor in tensors.values()]
        check_same({"numbers of a Gaussian": sum(widths)}, self.rows.device)
        flat = [tensor.reshape(len(self.rows), width) for tensor, width in zip(tensors.values(), widths)]
        parts = _Exchange.apply(torch.cat(flat, 1), *self._counts).split(widths, 1)
        return {name: part.reshape(-1, *tensors[name].shape[1:]) for name, part in zip(tensors, parts)}


class _TakenRows(torch.autograd.Function):
    """Rows of a tensor, whose gradient is sparse."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(rows)
        ctx.shape = tensor.shape
        return tensor[rows]

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        (rows,) = ctx.saved_tensors
        return torch.sparse_coo_tensor(rows[None], gradient, ctx.shape, check_invariants=False), None


class _Exchange(torch.autograd.Function):
    """Rows [S, F] that go to other processes, in exchange for theirs; gradients go back."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
        ctx.counts = sent, received
        return _sent(rows, sent, received)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        sent, received = ctx.counts
        return _sent(gradient, received, sent), None, None


def _sent(rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
    """Send rows [S, F], `sent` of them to each process, and return the `received` ones."""
    came = rows.new_empty(sum(received), rows.shape[1])
    dist.all_to_all_single(came, rows.contiguous(), received, sent)
    return came
