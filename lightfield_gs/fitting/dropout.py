"""Gaussians that a step leaves out (Park et al., "DropGaussian: Structural Regularization for Sparse-view Gaussian
Splatting", CVPR 2025; csrc/math/fit/dropout.h).

Few photographs leave much unsaid, and Gaussians that fill only what one of them shows stand in the way of views between
them. When each step draws another random part of them, none can count on others to hide it, and all see gradients.

It is off unless asked for, since what it gains is a matter of the scene more than of the number of photographs. 0.2 at
the end against none, 7,000 steps, 9 to 12 photographs, PSNR of those held out: bananas +0.6 to +0.8 dB, a plush figure
+0.2 and +0.7, rendered scenes -0.5 to +0.4; and of captures that this was not decided on, a real door -1.5, a rendered
door -0.2, rendered toys +0.3 (docs/benchmarks.md). Short fits do not tell, for overfitting shows late: in a tenth of
the steps it loses in nearly all of these.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.checks import expect, whole_number
from lightfield_gs.base.cuda import device_guard
from lightfield_gs.base.errors import InputError
from lightfield_gs.fitting.native import check_tensor, core_of, stream_of
from lightfield_gs.fitting.settings import FitSettings

_FEW = 12  # photographs, up to which it gained most in what was measured, and a fit speaks of it
_FORMER_MOST, _FORMER_FEW, _FORMER_MANY = 0.2, 12, 48  # of the default that was: 0.2 up to 12 photographs, 0 from 48 on


def words_on_dropout(settings: FitSettings, photographs: int) -> str | None:
    """What a fit to so many photographs says of dropout; None: nothing."""
    if settings.dropout > 0:
        return f"steps leave out a random part of the Gaussians, up to {settings.dropout:.0%} at the end (--dropout)"
    if photographs > _FEW:
        return None
    return (
        f"steps leave out no Gaussians: with {photographs} photographs --dropout 0.2 gains up to 1 dB or loses up to "
        "1.5, by the scene; compare the PSNR of photographs held out"
    )


def former_default(photographs: float) -> float:
    """The share at the end, 0..1, that a fit to so many photographs had where its checkpoint holds null for it."""
    return _FORMER_MOST * min(1.0, max(0.0, (_FORMER_MANY - photographs) / (_FORMER_MANY - _FORMER_FEW)))


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
        rates=shares.data_ptr(),
        rows=len(shares),
        step=step.data_ptr(),
        seed=whole_number("seed", seed, 0, 2**64 - 1),
        count=count,
        factors=factors.data_ptr(),
    )
    with device_guard(device):
        if shares.is_cuda:
            _core.cuda.dropout(job, stream_of(device))
        else:
            core.dropout(job, torch.get_num_threads())
    return factors
