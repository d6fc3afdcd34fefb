"""Derivatives that images do not have are refused: second ones, and those of forward mode."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, NoReturn

import torch
from torch import Tensor
from torch.autograd import forward_ad

from lightfield_gs.base.errors import InputError


def differentiable_once(reverse: Callable[..., tuple]) -> Callable[..., tuple]:
    """The reverse `reverse`(ctx, *grads) of a node of autograd, whose gradients refuse to be differentiated.

    Unlike torch's once_differentiable it refuses with a loss that is linear in the image too, and in autograd.grad:
    there second derivatives were none, without a word.
    """

    @wraps(reverse)
    def first(ctx: Any, *grads: Tensor | None) -> tuple:
        with torch.no_grad():
            found = reverse(ctx, *grads)
        if not torch.is_grad_enabled():
            return found
        depends_on = [t for t in (*ctx.saved_tensors, *grads) if t is not None and t.requires_grad]
        known = [t for t in found if t is not None]
        refusing = iter(_Refusal.apply(len(known), *known, *depends_on))
        return tuple(None if t is None else next(refusing) for t in found)

    return first


class _Refusal(torch.autograd.Function):
    """The first `count` of the tensors, as what depends on all others, by a derivative that there is not."""

    @staticmethod
    def forward(ctx, count, *tensors):
        return tensors[:count]

    @staticmethod
    def backward(ctx, *grads) -> NoReturn:
        raise InputError(
            "images are differentiable once, and a second derivative was asked for: leave create_graph out, or take "
            "differences of first derivatives"
        )


def refuse_tangents(*arguments: object) -> None:
    """Raises InputError for a dual number (torch.autograd.forward_ad) among the arguments."""
    for tensor in arguments:
        if isinstance(tensor, Tensor) and forward_ad.unpack_dual(tensor).tangent is not None:
            raise InputError(
                "images have no derivatives in forward mode, and an argument is a dual number: use backward()"
            )
