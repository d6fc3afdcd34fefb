"""How torch operators are made: schemas from named tuples, gradients, batches of vmap, the refusal of second ones.

An operator has one node of autograd for every way of calling it: eagerly, under torch.func, and while torch.compile or
torch.export trace it. torch.library.register_autograd has none for torch.func, and takes the host 0.1 ms for a call.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, NoReturn, get_type_hints

import torch
from torch import Tensor
from torch._functorch.autograd_function import enable_single_level_autograd_function
from torch.autograd import forward_ad

from lightfield_gs.base.arrays import is_eager
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
LIBRARY = torch.library.Library("lightfield_gs", "FRAGMENT")


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


def _nothing_to_keep(ctx: Any, inputs: tuple, output: Any) -> None:
    """Set up the context of a node whose backward needs nothing."""


def _refuse_second(ctx: Any, *grads: Tensor | None) -> NoReturn:
    raise InputError(
        "images are differentiable once, and a second derivative was asked for: leave create_graph out, or take "
        "differences of first derivatives"
    )


def _refuse_forward_mode(ctx: Any, *tangents: Tensor | None) -> NoReturn:
    raise InputError("images have no derivatives in forward mode, and an argument is a dual number: use backward()")


def register_operator(
    name: str,
    schema: str,
    function: Callable[..., Any],
    fake: Callable[..., Any],
    setup_context: Callable[..., None] = _nothing_to_keep,
    backward: Callable[..., Any] = _refuse_second,
    batches: bool = True,
) -> Callable[..., Any]:
    """Register lightfield_gs::`name`; return a function that calls it, or `function` itself where that does the same.

    Args:
        name: of the operator.
        schema: of its arguments and outputs.
        function: from arguments to outputs, on the CPU and CUDA.
        fake: the same for the shapes of the outputs.
        setup_context: of the node of autograd, from ctx, inputs and output.
        backward: of the node. Without one, the operator is a backward itself, and refuses second derivatives.
        batches: whether all tensors begin with a dimension of scenes or images, so that vmap makes it longer. Else
            vmap calls the operator for each.
    """
    LIBRARY.define(name + schema)
    overload = getattr(torch.ops.lightfield_gs, name).default
    defaults = [argument.default_value for argument in overload._schema.arguments]

    def forward(*inputs: Any) -> Any:
        if is_eager(inputs):
            return function(*inputs)
        # A node turns gradients off, and the transforms around this one may ask for theirs
        with torch.enable_grad(), forward_ad._set_fwd_grad_enabled(True), torch._C._AutoDispatchBelowAutograd():
            return overload(*inputs)

    def differentiate(*arguments: Any) -> Any:
        return node.apply(*arguments, *defaults[len(arguments) :])

    def differentiate_in_transforms(*arguments: Any) -> Any:
        # torch.func calls this for one transform after the other. Function.apply would begin again with all of them
        with enable_single_level_autograd_function():
            return super(torch.autograd.Function, node).apply(*arguments, *defaults[len(arguments) :])

    def call(*arguments: Any) -> Any:
        if not is_eager(arguments):
            return overload(*arguments)
        return differentiate(*arguments) if torch.is_grad_enabled() else function(*arguments)

    members = {"forward": forward, "setup_context": setup_context, "backward": backward, "jvp": _refuse_forward_mode}
    node: Any = type(name, (torch.autograd.Function,), {key: staticmethod(member) for key, member in members.items()})
    for device in ("CPU", "CUDA"):
        LIBRARY.impl(name, function, device)
    LIBRARY.impl(name, differentiate_in_transforms, "Autograd")
    torch.library.register_fake(f"lightfield_gs::{name}", fake, lib=LIBRARY)
    register_batches(name, call, batches)
    return call


def register_batches(name: str, call: Callable[..., Any], batches: bool = True) -> None:
    """Register how torch.func.vmap calls lightfield_gs::`name`; see register_operator."""
    names = [argument.name for argument in getattr(torch.ops.lightfield_gs, name).default._schema.arguments]

    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> tuple[Any, Any]:
        dims = dict(zip(names, in_dims))
        state_of_each = "lists" not in names or dims["lists"] is None and dims["splats"] is not None
        rule = _merged if batches and state_of_each else _one_by_one
        return rule(call, names, info.batch_size, in_dims, arguments)

    torch.library.register_vmap(f"lightfield_gs::{name}", vmap, lib=LIBRARY)


def _merged(
    call: Callable[..., Any], names: list[str], size: int, in_dims: tuple[int | None, ...], arguments: tuple[Any, ...]
) -> tuple[Any, Any]:
    """Return outputs and their dimensions of vmap from one call with `size` times as many scenes.

    The lists of all images are one tensor, which belongs to every row of the batch: the backward merges rows alike.
    """

    def longer(name: str, value: Any, dim: int | None) -> Any:
        if not isinstance(value, Tensor) or name == "lists":
            return value * size if name == "scenes" else value
        rows = value.expand(size, *value.shape) if dim is None else value.movedim(dim, 0)
        return rows.flatten(0, 1)

    found = call(*map(longer, names, arguments, in_dims))
    several = found if isinstance(found, tuple) else (found,)
    dims = tuple(None if tensor.dtype == torch.uint8 else 0 for tensor in several)
    outputs = tuple(t if dim is None else t.unflatten(0, (size, -1)) for t, dim in zip(several, dims))
    return (outputs, dims) if isinstance(found, tuple) else (outputs[0], dims[0])


def _one_by_one(
    call: Callable[..., Any], names: list[str], size: int, in_dims: tuple[int | None, ...], arguments: tuple[Any, ...]
) -> tuple[Any, Any]:
    """Return outputs and their dimensions of vmap from `size` calls."""

    def one(row: int) -> Any:
        given = zip(arguments, in_dims)  # numbers in lists have lists of dimensions
        return call(*(t.select(dim, row) if isinstance(t, Tensor) and dim is not None else t for t, dim in given))

    found = [one(row) for row in range(size)]
    if isinstance(found[0], Tensor):
        return torch.stack(found), 0
    return tuple(torch.stack(outputs) for outputs in zip(*found)), (0,) * len(found[0])


def differentiable_once(backward: Callable[..., tuple]) -> Callable[..., tuple]:
    """Wrap the `backward`(ctx, *grads) of an eager node of autograd: its gradients refuse to be differentiated.

    Unlike torch's once_differentiable it also refuses for a loss that is linear in the image, and in autograd.grad.
    There torch would return no second derivatives, without an error.
    """

    @wraps(backward)
    def first(ctx: Any, *grads: Tensor | None) -> tuple:
        if not torch.is_grad_enabled():
            return backward(ctx, *grads)
        return _Once.apply(lambda: backward(ctx, *grads), *ctx.saved_tensors, *grads)

    return first


class _Once(torch.autograd.Function):
    """Return what a function returns, as functions of tensors whose derivative is an error."""

    @staticmethod
    def forward(ctx, function, *tensors):
        return function()

    backward = staticmethod(_refuse_second)


def refuse_tangents(*arguments: object) -> None:
    """Raise InputError if an argument is a dual number (torch.autograd.forward_ad)."""
    if torch.compiler.is_compiling():
        return  # the nodes of operators refuse them
    for tensor in arguments:
        if isinstance(tensor, Tensor) and forward_ad.unpack_dual(tensor).tangent is not None:
            _refuse_forward_mode(None)
