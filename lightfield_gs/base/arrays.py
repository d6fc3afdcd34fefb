"""Arrays and tensors: conversion of arguments, backgrounds, bytes of pictures, and the sRGB curve."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache, wraps
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter

from lightfield_gs.base.checks import expect, shown, wrong_type
from lightfield_gs.base.errors import InputError

_Function = TypeVar("_Function", bound=Callable)
Colour = Sequence[float] | np.ndarray | Tensor  # red, green and blue, or anything that broadcasts to them


def is_eager(arguments: tuple) -> bool:
    """Return whether all tensors are plain and have values, and nothing traces, transforms or compiles what is called.

    Else values cannot be read, and are not checked. The function of an operator may be called without the operator only
    if this is true.
    """
    if torch.compiler.is_compiling():
        return False
    if torch._C._are_functorch_transforms_active() or torch._C._len_torch_dispatch_stack():
        return False
    return all(type(t) in (Tensor, Parameter) and not t.is_meta for t in arguments if isinstance(t, Tensor))


def for_graphs(function: _Function) -> _Function:
    """Return a function that torch.compile takes into its graphs from torch 2.11 on.

    Earlier compilers fail in it. They leave it out, as by torch.compiler.disable, which is called late: it takes 2 s in
    programs that compile nothing. With fullgraph=True they raise an error, which names the function below.
    """
    if torch.__version__ >= "2.11":  # compared by numbers
        return function
    disabled: list[Callable] = []

    @wraps(function)
    def whole_graphs_need_torch_2_11(*arguments: Any, **options: Any) -> Any:
        if "torch._dynamo" not in sys.modules:
            return function(*arguments, **options)
        if not disabled:
            disabled.append(torch.compiler.disable(function))
        return disabled[0](*arguments, **options)

    return cast(_Function, whole_graphs_need_torch_2_11)


def to_tensor(what: str, value: np.ndarray | Tensor, meta: bool = False) -> Tensor:
    """Return `value` as a dense tensor, without a copy if possible.

    Args:
        what: name of the value in messages.
        value: real numbers.
        meta: whether a tensor may be without values.

    Raises:
        InputError: the value is no array or tensor of real numbers, or is sparse.
    """
    expect(what, value, np.ndarray, Tensor)
    if isinstance(value, np.ndarray):
        try:
            value = torch.from_numpy(np.ascontiguousarray(value))
        except TypeError:
            raise InputError(f"{what}: expected numbers, got {value.dtype}") from None
    if value.layout != torch.strided or value.is_meta and not meta:
        raise InputError(f"{what}: expected a dense tensor, got {value.layout} on {value.device}")
    if value.is_complex():
        raise InputError(f"{what}: expected real numbers, got {value.dtype}")
    return value


def to_bytes(colours: Tensor) -> Tensor:
    """Round colours in 0..1 to uint8, ties to even, as byte_of of math/image_byte.h does; overwrites `colours`."""
    return colours.clamp_(0, 1).mul_(255).round_().to(torch.uint8)


def encode_srgb(light: np.ndarray) -> np.ndarray:
    """Return the sRGB code 0..1 of linear light 0..1 (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def decode_srgb(code: np.ndarray) -> np.ndarray:
    """Return the linear light 0..1 of an sRGB code 0..1 (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0) + 0.055) / 1.055) ** 2.4)


def check_tensor(
    what: str, value: object, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device, writes: bool = False
) -> Tensor:
    """Return a tensor contiguous, after checking it.

    Args:
        what: its name in messages.
        value: the tensor.
        shape: expected, as are dtype and device.
        dtype: expected.
        device: expected.
        writes: whether it is written to, and so must be contiguous itself.

    Raises:
        InputError: for another type, shape, dtype or device.
    """
    if not isinstance(value, Tensor):
        raise wrong_type(what, value, Tensor)
    if value.shape != shape:
        raise InputError(f"{what} must be {list(shape)}, got {list(value.shape)}")
    if value.dtype != dtype or value.device != device:
        raise InputError(f"{what} must be {dtype} on {device}, got {value.dtype} on {value.device}")
    if writes and not value.is_contiguous():
        raise InputError(f"{what} is written to and must be contiguous; use .contiguous()")
    return value.contiguous()


def background_tensor(background: Colour, like: Tensor) -> Tensor:
    """Return a background as a tensor [..., 3] of the dtype and on the device of `like`. Raises InputError."""
    if isinstance(background, (tuple, list)) and all(isinstance(c, (int, float)) for c in background):
        if not is_eager((like,)):
            return like.new_tensor(_checked_numbers(background))
        if like.is_cuda and torch.cuda.is_current_stream_capturing():
            return _captured_background(background, like)
        return _constant_background(tuple(background), like.dtype, like.device)
    return _checked_background(background, like.dtype, like.device)


def _captured_background(background: Sequence[float], like: Tensor) -> Tensor:
    """Return a background that a graph under capture makes itself, in its own memory.

    A graph would keep only the address of an outside tensor, where other data may lie at a replay.
    """
    return torch.stack([like.new_full((), number) for number in _checked_numbers(background)])


@lru_cache(maxsize=64)
def _constant_background(background: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a background of plain numbers; cached, for each copy to a device waits for the device."""
    with torch.inference_mode(False):  # it may be part of a graph of gradients later
        return torch.tensor(_checked_numbers(background), dtype=dtype, device=device)


def _checked_numbers(background: Sequence[float]) -> list[float]:
    """Return plain numbers of a background. Raises InputError."""
    if len(background) != 3 or not all(-math.inf < number < math.inf for number in background):
        raise _not_three(shown(background))
    if not all(0 <= number <= 1 for number in background):
        raise _too_large(background)
    return list(background)


def _not_three(got: str) -> InputError:
    return InputError(f"background must be three finite numbers R, G, B in 0..1, got {got}")


def _too_large(background: Colour) -> InputError:
    return InputError(f"background must be three numbers R, G, B in 0..1, got {shown(background)}; divide bytes by 255")


def _checked_background(background: Colour, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return a background of any kind as a tensor. A search for NaN on a GPU would wait for it, and is left out.

    Tensors and arrays may hold values beyond 0..1, as optimizers make them; plain numbers beyond 0..1 are mistakes.
    """
    plain = True
    if isinstance(background, (Tensor, np.ndarray)):
        plain, background = False, to_tensor("background", background, device.type == "meta")
    unread = isinstance(background, Tensor) and (background.is_cuda or not is_eager((background,)))
    try:
        colour = torch.as_tensor(background, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise _not_three(type(background).__name__) from None
    if colour.dim() == 0 or colour.shape[-1] != 3 or not (unread or bool(torch.isfinite(colour).all())):
        raise _not_three(shown(background))
    if plain and not bool(((colour >= 0) & (colour <= 1)).all()):
        raise _too_large(background)
    return colour
