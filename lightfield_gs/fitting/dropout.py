"""Gaussians that a step leaves out (Park et al., "DropGaussian: Structural Regularization for Sparse-view Gaussian
Splatting", CVPR 2025; csrc/math/fit/dropout.h).

Few photographs leave much unsaid, and Gaussians that fill only what one of them shows stand in the way of views between
them. When each step draws another random part of them, none can count on others to hide it, and all see gradients.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import guard
from lightfield_gs.base.checks import expect, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.native import check_tensor, core_of, stream_of
from lightfield_gs.fitting.settings import FitSettings

# The share at the end of a fit to few photographs, how many these are, and from how many on there is none: with 12 of
# bananas 0.2 is 1 dB better than none, with 85 of a plush figure 0.1 is as good as none and 0.2 is 0.2 dB worse
_MOST, _FEW, _MANY = 0.2, 12, 48


def share_at_end(settings: FitSettings, photographs: int, shares: Sequence[float] | None = None) -> float:
    """settings.dropout, or what is right for so many photographs, 0..1. shares: in how many of the epochs each is."""
    if settings.dropout is not None:
        return settings.dropout
    number = photographs if shares is None else sum(shares)
    return _MOST * min(1.0, max(0.0, (_MANY - number) / (_MANY - _FEW)))


def dropout(shares: Tensor, step: Tensor, seed: int, count: int) -> Tensor:
    """Factors [count] of the opacities in a step: 0 for the share that is left out, 1 / (1 - share) for the others.

    shares [steps], 0 or more and less than 1; step: one int64, whose value is read on the device, so that a CUDA graph
    can repeat the call for all steps; nothing is left out in a step that shares do not have. float32, on the CPU also
    float64. seed: 0..2^64-1. Raises InputError for other dtypes, shapes or devices.
    """
    expect("shares", shares, Tensor)
    if shares.dim() != 1:
        raise InputError(f"shares must be [steps], got {list(shares.shape)}")
    core, device = core_of("shares", shares), shares.device
    expect("step", step, Tensor)
    check_tensor("step", step.reshape(-1), (1,), torch.int64, device)
    shares = shares.contiguous()
    factors = shares.new_empty(whole_number("count", count, 0, 2**40))
    job = core.Dropout(
        shares=shares.data_ptr(),
        rows=len(shares),
        step=step.data_ptr(),
        seed=whole_number("seed", seed, 0, 2**64 - 1),
        count=count,
        factors=factors.data_ptr(),
    )
    with guard(device):
        if shares.is_cuda:
            _core.cuda.dropout(job, stream_of(device))
        else:
            core.dropout(job, torch.get_num_threads())
    return factors
