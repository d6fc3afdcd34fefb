"""What the wrappers of the fitting stages share: the native functions of a device."""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError


def core_of(what: str, tensor: Tensor) -> type[_core._Stages]:
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
