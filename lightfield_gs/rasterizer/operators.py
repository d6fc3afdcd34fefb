"""Tools of the torch operators of images: schemas from named tuples, and the refusal of second derivatives."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, NoReturn, get_type_hints

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import Parameter

from lightfield_gs.base.errors import InputError

_SCHEMA_TYPES = {
    Tensor: "Tensor",
    Tensor | None: "Tensor?",
    bool: "bool",
    int: "SymInt",
    float: "float",
    list[int]: "SymInt[]",
    list[float]: "float[]",
}


def operator_schema(*arguments: type, outputs: int, defaults: bool = True, omit: tuple[str, ...] = ()) -> str:
    """Return the schema of an operator.

    Args:
        arguments: named tuples, whose fields are the arguments of the operator in this order.
        outputs: how many tensors it returns.
        defaults: whether arguments have the default values of the fields.
        omit: fields that are no arguments.
    """
    declared = []
    for kind in arguments:
        values = getattr(kind, "_field_defaults", {}) if defaults else {}
        for name, hint in get_type_hints(kind).items():
            if name not in omit:
                declared.append(f"{_SCHEMA_TYPES[hint]} {name}" + (f"={values[name]}" if name in values else ""))
    returned = "Tensor" if outputs == 1 else f"({', '.join(['Tensor'] * outputs)})"
    return f"({', '.join(declared)}) -> {returned}"


def is_eager(arguments: tuple) -> bool:
    """Return whether all tensors are plain and nothing is being compiled.

    Then an operator's function may be called without the operator. Recording the operator for a trace or a compiler
    takes the host 0.1 ms each time, while the device waits.
    """
    plain = all(type(t) in (Tensor, Parameter) for t in arguments if isinstance(t, Tensor))
    return plain and not torch.compiler.is_compiling()


def differentiable_operator(
    name: str,
    schema: str,
    forward: Callable[..., Any],
    fake: Callable[..., Any],
    setup_context: Callable[..., None],
    backward: Callable[..., tuple],
) -> Callable[..., Any]:
    """Register lightfield_gs::`name` with its backward; return a function that calls it, without the operator if eager.

    Args:
        name: of the operator.
        schema: of its arguments and outputs.
        forward: from arguments to outputs.
        fake: the same for the shapes of the outputs.
        setup_context: see torch.library.register_autograd.
        backward: likewise; wrapped by differentiable_once.
    """
    operator = torch.library.custom_op(
        f"lightfield_gs::{name}", forward, mutates_args=(), device_types=("cpu", "cuda"), schema=schema
    )
    operator.register_fake(fake)
    operator.register_autograd(backward, setup_context=setup_context)

    def apply_forward(ctx: Any, *inputs: Any) -> Any:
        outputs = forward(*inputs)
        setup_context(ctx, inputs, outputs)
        return outputs

    members = {"forward": staticmethod(apply_forward), "backward": staticmethod(backward)}
    node: Any = type(name, (torch.autograd.Function,), members)

    def call(*arguments: Any) -> Any:
        return node.apply(*arguments) if is_eager(arguments) else operator(*arguments)

    return call


def differentiable_once(backward: Callable[..., tuple]) -> Callable[..., tuple]:
    """Wrap the `backward`(ctx, *grads) of a node of autograd: its gradients refuse to be differentiated.

    Unlike torch's once_differentiable it also refuses for a loss that is linear in the image, and in autograd.grad.
    There torch would return no second derivatives, without an error.
    """

    @wraps(backward)
    def first(ctx: Any, *grads: Tensor | None) -> tuple:
        with torch.no_grad():
            found = backward(ctx, *grads)
        if not torch.is_grad_enabled():
            return found
        depends_on = [t for t in (*ctx.saved_tensors, *grads) if t is not None and t.requires_grad]
        known = [t for t in found if t is not None]
        refusing = iter(_Refusal.apply(len(known), *known, *depends_on))
        return tuple(None if t is None else next(refusing) for t in found)

    return first


class _Refusal(torch.autograd.Function):
    """Return the first `count` tensors as functions of all others, whose derivative is an error."""

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
    """Raise InputError if an argument is a dual number (torch.autograd.forward_ad)."""
    for tensor in arguments:
        if isinstance(tensor, Tensor) and forward_ad.unpack_dual(tensor).tangent is not None:
            raise InputError(
                "images have no derivatives in forward mode, and an argument is a dual number: use backward()"
            )
