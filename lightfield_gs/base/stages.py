"""Checks and launches of native stages, on the CPU and on CUDA."""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.device import device_guard
from lightfield_gs.base.errors import InputError


def select_stages(what: str, tensor: Tensor) -> ModuleType:
    """Return the native stages for a tensor's precision.

    Raises:
        InputError: there are no stages for its dtype and device. CUDA has stages for float32 only.
    """
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


def run_stage(name: str, stages: ModuleType, device: torch.device, *arguments: object) -> None:
    """Run a stage on the CPU, or queue it in torch's current stream of a CUDA device.

    Args:
        name: of the stage.
        stages: the native functions for the CPU.
        device: where the tensors are.
        arguments: of the stage, except threads and stream.
    """
    with device_guard(device):
        if device.type == "cuda":
            getattr(_core.cuda, name)(*arguments, torch.cuda.current_stream(device).cuda_stream)
        else:
            getattr(stages, name)(*arguments, torch.get_num_threads())


def optional_address(tensor: Tensor | None) -> int:
    """Return the address of a tensor, 0 for None."""
    return 0 if tensor is None else tensor.data_ptr()
