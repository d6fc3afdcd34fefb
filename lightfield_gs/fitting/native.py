"""What the wrappers of the fitting stages share: checks of tensors, and the native functions of a device."""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError


def check_tensor(
    what: str, value: object, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device, writes: bool = False
) -> Tensor:
    """`value` contiguous. Raises InputError unless it is a tensor of this shape and dtype on this device; writes: also
    unless it is contiguous itself, since what is written to a copy would be lost."""
    expect(what, value, Tensor)
    assert isinstance(value, Tensor)
    if value.shape != shape:
        raise InputError(f"{what} must be {list(shape)}, got {list(value.shape)}")
    if value.dtype != dtype or value.device != device:
        raise InputError(f"{what} must be {dtype} on {device}, got {value.dtype} on {value.device}")
    if writes and not value.is_contiguous():
        raise InputError(f"{what} is written to and must be contiguous; use .contiguous()")
    return value.contiguous()


def core_of(what: str, tensor: Tensor) -> ModuleType:
    """The core's functions and buffers for the tensor's precision. Raises InputError where its dtype or device has no
    stages: CUDA has them for float32 only."""
    device, dtype = tensor.device, tensor.dtype
    if device.type not in ("cpu", "cuda") or tensor.is_cuda and not hasattr(_core, "cuda"):
        places = "the CPU or CUDA" if hasattr(_core, "cuda") else "the CPU: it was built without CUDA"
        raise InputError(f"{what}: this build fits on {places}, got {device}")
    if dtype == torch.float32:
        return _core.float32
    if dtype == torch.float64 and not tensor.is_cuda:
        return _core.float64
    wanted = "float32" if tensor.is_cuda else "float32 or float64"
    raise InputError(f"{what} must be {wanted} on {device}, got {dtype}")


def stream_of(device: torch.device) -> int:
    """The handle of torch's current stream of a CUDA device."""
    return torch.cuda.current_stream(device).cuda_stream


def optional_address(tensor: Tensor | None) -> int:
    return 0 if tensor is None else tensor.data_ptr()
