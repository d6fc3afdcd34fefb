"""Adam for a few numbers that each photograph has of its own, in torch's own operations."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from lightfield_gs.fitting.update import BETAS, EPSILON


class PhotographAdam:
    """Moments first and second [C,K] of K numbers for each of C photographs, and the rates of all steps.

    As in the program of Kerbl et al. 2023 all photographs move at every step: a gradient has its effect over some ten
    steps, whether or not its photograph is drawn in them. So how far one moves falls only with the root of C, where
    steps for none but those drawn would let it fall with C. What is void, or no number, changes nothing.
    """

    def __init__(
        self, shape: tuple[int, int], steps: int, rate: float, decay: float, dtype: torch.dtype, device: torch.device
    ):
        """The rate falls exponentially from `rate` to decay * rate over `steps`."""
        self.first, self.second = (torch.zeros(shape, dtype=dtype, device=device) for _ in range(2))
        rows = [
            [rate * math.exp(math.log(decay) * step / steps), *(1 - beta ** (step + 1) for beta in BETAS)]
            for step in range(steps)
        ]
        self._table = torch.tensor(rows, dtype=dtype, device=device)  # [steps,3]: rate, 1 - beta1^t, 1 - beta2^t

    def gathered(self, chosen: Tensor, values: Tensor) -> Tensor:
        """[C,K]: the sums of values [V,K] over the photographs `chosen` [V], of which some may be the same."""
        own = chosen[:, None] == torch.arange(len(self.first), device=chosen.device)
        return torch.where(own[..., None], values[:, None].to(self.first.dtype), 0).sum(0)

    def moves(self, gradient: Tensor, step: Tensor, kept: Tensor) -> Tensor:
        """[C,K]: what is to be added to the numbers, of a gradient [C,K]. step [1]: counted from 0; kept [1]: 1, or 0
        where the step is void, and all moves are zero."""
        gradient = torch.where(gradient.isfinite(), gradient, 0)
        first, second = (
            beta * moment + (1 - beta) * value
            for beta, moment, value in zip(BETAS, (self.first, self.second), (gradient, gradient.square()))
        )
        for moment, new in ((self.first, first), (self.second, second)):
            moment.copy_(torch.where(kept > 0, new, moment))
        rate, first_share, second_share = self._table.index_select(0, step)[0].unbind()
        move = -rate * (first / first_share) / ((second / second_share).sqrt() + EPSILON)
        return torch.where(kept > 0, move, 0)

    def tensors(self) -> dict[str, Tensor]:
        """The moments by name, for a checkpoint."""
        return {"first": self.first, "second": self.second}
