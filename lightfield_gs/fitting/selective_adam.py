"""Adam for the rows of parameters that a step has seen, for loops of one's own.

Sources: Kingma & Ba, "Adam: a method for stochastic optimization", ICLR 2015; Mallick et al., "Taming 3DGS", 2024, for
steps of visible Gaussians alone; Ye et al., "gsplat", JMLR 2025, for the name and the arguments.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer
from torch.optim.adam import adam

from lightfield_gs.base.checks import real_number
from lightfield_gs.base.errors import InputError

_MOMENTS = ("exp_avg", "exp_avg_sq")


class SelectiveAdam(Optimizer):
    """Adam that moves only some rows of each parameter [N, ...], and leaves the moments of the others as they are.

    The rows are those of sparse gradients, see rasterization(sparse_grad=True), or those of a mask. They are taken
    together, go through one fused step of torch's Adam, and are written back.

    A number moves by -lr m / (sqrt(v) + eps), as by gsplat's SelectiveAdam. With bias_correction the rate is lr
    sqrt(1 - beta2^t) / (1 - beta1^t), as by torch.optim.SparseAdam; t counts the steps of the parameter.
    """

    def __init__(
        self,
        params: Iterable[Any],
        eps: float = 1e-8,
        betas: tuple[float, float] = (0.9, 0.999),
        *,
        lr: float = 1e-3,
        bias_correction: bool = False,
    ) -> None:
        """Make the optimizer of some parameters.

        Args:
            params: parameters [N, ...], or groups of them with options of their own, as torch's optimizers take them.
            eps: added to the root of the second moment.
            betas: how much of the first and of the second moment a step keeps.
            lr: learning rate.
            bias_correction: whether the first steps make up for moments that begin from zeros.

        Raises:
            InputError: a number is out of its range.
        """
        first, second = (real_number("betas", beta, 0, 0.9999999) for beta in betas)
        options = {"lr": real_number("lr", lr, 0, 1e30), "eps": real_number("eps", eps, 0, 1)}
        super().__init__(params, {**options, "betas": (first, second), "bias_correction": bias_correction})

    @torch.no_grad()
    def step(self, visibility: Tensor | None = None) -> None:  # type: ignore[override]
        """Move the rows that were seen; parameters without a gradient stay.

        Args:
            visibility: [N], the rows to move are not zero; None: gradients are sparse, and their rows move.

        Raises:
            InputError: a gradient is dense and there is no mask of its rows, or it is sparse and there is one.
        """
        # Once for all parameters: a device waits for it
        seen = None if visibility is None else visibility.reshape(-1).nonzero()[:, 0]
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is not None:
                    self._move(parameter, group, *_rows(parameter, visibility, seen))

    def _move(self, parameter: Tensor, group: dict[str, Any], rows: Tensor, gradient: Tensor) -> None:
        """Move rows [M] of a parameter against their gradients [M, ...]."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros(())
            state |= {name: torch.zeros_like(parameter) for name in _MOMENTS}
        state["step"] += 1
        beta1, beta2 = group["betas"]
        rate = group["lr"]
        if group["bias_correction"]:
            step = float(state["step"])
            rate *= math.sqrt(1 - beta2**step) / (1 - beta1**step)
        whole = (parameter, *(state[name] for name in _MOMENTS))
        values, first, second = taken = [tensor[rows] for tensor in whole]
        # After infinitely many steps Adam has no correction of its own
        steps = [torch.full((), math.inf, device=values.device)]
        options = {"lr": rate, "beta1": beta1, "beta2": beta2, "eps": group["eps"]}
        adam(
            [values], [gradient], [first], [second], [], steps,
            fused=True, amsgrad=False, weight_decay=0.0, maximize=False, **options,
        )  # fmt: skip
        for tensor, moved in zip(whole, taken):
            tensor[rows] = moved


def _rows(parameter: Tensor, visibility: Tensor | None, seen: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return the rows [M] of a parameter that move, each once, and their gradients [M, ...]. Raises InputError.

    Args:
        parameter: with its gradient.
        visibility: [N], see SelectiveAdam.step.
        seen: [M], its rows that are not zero.
    """
    gradient = parameter.grad
    assert gradient is not None
    shape = list(parameter.shape)
    if gradient.is_sparse:
        if visibility is not None:
            raise InputError(f"visibility: the gradient of {shape} is sparse, and has rows of its own: leave it out")
        gradient = gradient.coalesce()
        return gradient.indices()[0], gradient.values()
    if visibility is None or seen is None:
        raise InputError(
            f"visibility: expected the rows of {shape} to move, got none, and the gradient is dense: give a mask "
            f"[{shape[0] if shape else 'N'}], or ask for sparse gradients"
        )
    if not shape or visibility.numel() != shape[0]:
        raise InputError(f"visibility: expected {shape[:1]}, a number for each row, got {list(visibility.shape)}")
    return seen, gradient[seen]
