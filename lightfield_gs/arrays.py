"""Arrays and tensors as they are given."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.errors import InputError, expect


def dense_tensor(what: str, value: np.ndarray | Tensor) -> Tensor:
    """`value` as a tensor, without a copy where that can be. Raises InputError on what holds no numbers in memory."""
    expect(what, value, np.ndarray, Tensor)
    if isinstance(value, Tensor):
        if value.layout != torch.strided or value.is_meta:
            raise InputError(f"{what}: expected a dense tensor, got {value.layout} on {value.device}")
        return value
    try:
        return torch.from_numpy(np.ascontiguousarray(value))
    except TypeError:
        raise InputError(f"{what}: expected numbers, got {value.dtype}") from None
