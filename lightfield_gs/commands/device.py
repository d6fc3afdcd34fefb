"""The device that a command runs on."""

from __future__ import annotations

from lightfield_gs.errors import InputError


def choose_device(name: str) -> str:
    """cpu or cuda, for cpu, cuda or auto. Raises InputError where cuda is asked for and cannot be had."""
    import torch

    from lightfield_gs import build_info

    usable = "cuda" in build_info()["devices"] and torch.cuda.is_available()
    if name == "cuda" and not usable:
        raise InputError("--device cuda: needs a GPU, a torch that uses it, and a build that found nvcc (LFGS_CUDA=ON "
                         "insists on it); use --device cpu")
    return "cuda" if usable and name != "cpu" else "cpu"
