"""The device that a command runs on."""

from __future__ import annotations

import os
from typing import Literal, cast

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Device


def choose_device(name: Device) -> Literal["cpu", "cuda"]:
    """cpu or cuda, for cpu, cuda or auto. Raises InputError where cuda is asked for and cannot be had."""
    if name == "cpu":
        return "cpu"
    missing = _missing_for_cuda()
    if name == "cuda" and missing is not None:
        raise InputError(f"device='cuda': {missing}, or use device='cpu'")
    return "cpu" if missing else "cuda"


def _missing_for_cuda() -> str | None:
    """Which of the three things that cuda takes is not there, and what to do; None where none is missing."""
    import torch

    from lightfield_gs import build_info

    if "cuda" not in cast(list[str], build_info()["devices"]):
        return "this build has no CUDA stages; install it with nvcc on the PATH and -C cmake.define.LFGS_CUDA=ON"
    if torch.version.cuda is None:
        return f"this torch, {torch.__version__}, is a CPU build; install a CUDA build of torch"
    if not torch.cuda.is_available():
        return f"torch {torch.__version__} finds no GPU that it can use; see whether nvidia-smi lists one"
    return None


def cores() -> list[int]:
    """The cores that this process may use; those of the machine where the system does not tell (macOS, Windows)."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))
