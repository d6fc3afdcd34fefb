"""Rows of torch's parameters and of their optimizers' states, changed together.

A loop of one's own keeps its Gaussians in parameters [N, ...] by name, each in an optimizer of its own. Density control
takes, copies and removes rows of all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, MutableMapping
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from lightfield_gs.base.errors import InputError

Parameters = MutableMapping[str, Any]  # of Parameter [N, ...]; torch's ParameterDict is one in all but its type
Optimizers = MutableMapping[str, Optimizer]


def check_parameters(params: Parameters, optimizers: Optimizers, needed: Iterable[str]) -> None:
    """Raise InputError unless all that are optimised have an optimizer of their own, and the needed names are there."""
    names = {name for name, value in params.items() if value.requires_grad}
    if missing := sorted(set(needed) - set(params.keys())):
        raise InputError(f"params: expected {', '.join(sorted(needed))}, got no {', '.join(missing)}")
    if names != set(optimizers.keys()):
        raise InputError(
            f"optimizers: expected one for each parameter that asks for gradients ({', '.join(sorted(names))}), got "
            f"{', '.join(sorted(optimizers.keys()))}"
        )
    for name, optimizer in optimizers.items():
        if len(optimizer.param_groups) != 1 or len(optimizer.param_groups[0]["params"]) != 1:
            raise InputError(
                f"optimizers[{name}]: expected one parameter in one group, got {len(optimizer.param_groups)} groups"
            )


@torch.no_grad()
def take_rows(
    params: Parameters,
    optimizers: Optimizers,
    rows: Tensor,
    fresh: Tensor,
    change: Callable[[str, Tensor], Tensor] = lambda name, taken: taken,
) -> None:
    """Replace all parameters by some of their rows.

    Args:
        params: by name, [N, ...].
        optimizers: of these names; numbers that they keep for each row are taken with the rows.
        rows: [M] whole numbers, the row that each new one is taken from.
        fresh: [M] bool, the new rows for which optimizers begin from zeros.
        change: from a name and the taken rows to the values of the new parameter.
    """
    for name in list(params.keys()):
        old = params[name]
        new = Parameter(change(name, old.detach()[rows]), requires_grad=old.requires_grad)
        _replace(params, optimizers, name, new, lambda kept: _zeroed(kept[rows], fresh))


@torch.no_grad()
def set_rows(
    params: Parameters, optimizers: Optimizers, values: dict[str, Tensor], fresh: Tensor, like: Tensor | None = None
) -> None:
    """Replace values of parameters, as many rows as before.

    Args:
        params: by name, [N, ...].
        optimizers: of these names.
        values: of some parameters, [N, ...].
        fresh: [N] bool, the rows for which the optimizers of these begin from zeros.
        like: [N] whole numbers; of the other parameters row i becomes as row like[i] was. None: they stay.
    """
    for name in list(params.keys()):
        if name in values or like is not None:
            old = params[name]
            value = values[name] if name in values else old.detach()[like]
            _replace(
                params,
                optimizers,
                name,
                Parameter(value, requires_grad=old.requires_grad),
                lambda kept: _zeroed(kept.clone(), fresh),
            )


def _zeroed(kept: Tensor, fresh: Tensor) -> Tensor:
    kept[fresh] = 0
    return kept


def _replace(
    params: Parameters, optimizers: Optimizers, name: str, new: Parameter, change: Callable[[Tensor], Tensor]
) -> None:
    """Put a parameter in the place of another, with the numbers that its optimizer keeps for each row changed."""
    old, count = params[name], len(params[name])
    params[name] = new
    if name not in optimizers:
        return
    optimizer = optimizers[name]
    kept = optimizer.state.pop(old, {})
    optimizer.state[new] = {
        key: change(value) if isinstance(value, Tensor) and value.ndim and len(value) == count else value
        for key, value in kept.items()
    }
    optimizer.param_groups[0]["params"] = [new]
