"""Arrays and tensors: conversion of what users give, bytes of pictures, and the sRGB curve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.checks import expect, wrong_type
from lightfield_gs.base.errors import InputError

Colour = Sequence[float] | np.ndarray | Tensor  # red, green and blue, or anything that broadcasts to them


def to_tensor(what: str, value: np.ndarray | Tensor) -> Tensor:
    """Return `value` as a dense tensor, without a copy if possible.

    Args:
        what: name of the value in messages.
        value: real numbers.

    Raises:
        InputError: the value is no array or tensor of real numbers, or is sparse.
    """
    expect(what, value, np.ndarray, Tensor)
    if isinstance(value, np.ndarray):
        try:
            value = torch.from_numpy(np.ascontiguousarray(value))
        except TypeError:
            raise InputError(f"{what}: expected numbers, got {value.dtype}") from None
    if value.layout != torch.strided or value.is_meta:
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
