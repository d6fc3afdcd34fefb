"""Arrays and tensors as they are given, and as they are stored."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError

Colour = Sequence[float] | np.ndarray | Tensor  # red, green and blue, or anything that broadcasts so


def dense_tensor(what: str, value: np.ndarray | Tensor) -> Tensor:
    """`value` as a tensor, without a copy where that can be. Raises InputError on what holds no real numbers."""
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


def bytes_of(colours: Tensor) -> Tensor:
    """round(255 clamp(c, 0, 1)), ties to even, as uint8: byte_of of math/image_byte.h. Writes over `colours`."""
    return colours.clamp_(0, 1).mul_(255).round_().to(torch.uint8)


def guard(device: torch.device) -> AbstractContextManager:
    """Selects the device, so that work goes to its stream; nothing is done where it is selected already."""
    if device.type != "cuda" or device.index == torch.cuda.current_device():
        return nullcontext()
    return torch.cuda.device(device)


def on_host(image: Tensor) -> np.ndarray:
    """A picture that nothing draws over any more. From CUDA into page-locked memory, which takes a third of the
    time."""
    if not image.is_cuda:
        return image.numpy()
    host = torch.empty(image.shape, dtype=image.dtype, pin_memory=True)
    return host.copy_(image).numpy()
