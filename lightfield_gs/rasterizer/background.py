"""What images are drawn over."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, to_tensor
from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError


def background_tensor(background: Colour, like: Tensor) -> Tensor:
    """A background as a tensor [..., 3] of the dtype and on the device of `like`. Raises InputError."""
    if isinstance(background, (tuple, list)) and all(isinstance(c, (int, float)) for c in background):
        if like.is_cuda and torch.cuda.is_current_stream_capturing():
            return _captured_background(background, like)
        return _constant_background(tuple(background), like.dtype, like.device)
    return _checked_background(background, like.dtype, like.device)


def _captured_background(background: Sequence[float], like: Tensor) -> Tensor:
    """A background that a graph under capture makes itself, in its own memory.

    Of a tensor from outside it would keep nothing but the address, where something else may lie at a replay.
    """
    numbers = _checked_background(background, like.dtype, torch.device("cpu")).tolist()
    return torch.stack([like.new_full((), number) for number in numbers])


@lru_cache(maxsize=64)
def _constant_background(background: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """A background of plain numbers. It is made once, for copying it to a device waits for that every time."""
    with torch.inference_mode(False):  # it may be part of a graph of gradients later
        return _checked_background(background, dtype, device)


def _checked_background(background: Colour, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A background of any kind as a tensor. One on a GPU is not searched for NaN, which would wait for the GPU.

    Tensors and arrays may hold values beyond 0..1, as optimizers make them; plain numbers beyond it are mistakes.
    """
    plain = True
    if isinstance(background, (Tensor, np.ndarray)):
        plain, background = False, to_tensor("background", background)
    there = isinstance(background, Tensor) and background.is_cuda
    try:
        colour = torch.as_tensor(background, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(
            f"background must be three finite numbers R, G, B in 0..1, got {type(background).__name__}"
        ) from None
    if colour.dim() == 0 or colour.shape[-1] != 3 or not (there or bool(torch.isfinite(colour).all())):
        raise InputError(f"background must be three finite numbers R, G, B in 0..1, got {shown(background)}")
    if plain and not bool(((colour >= 0) & (colour <= 1)).all()):
        raise InputError(
            f"background must be three numbers R, G, B in 0..1, got {shown(background)}; divide bytes by 255"
        )
    return colour
