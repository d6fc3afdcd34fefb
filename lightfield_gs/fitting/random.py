"""Random numbers as a function of seed, step, purpose and index (csrc/math/fit/random.h), and dropout by them.

A checkpoint need not hold them, and all runs on all devices draw the same. Normal numbers are equal up to the rounding
of logarithm, root, sine and cosine. The generator is Philox4x32-10 (Salmon et al., "Parallel random numbers: as easy as
1, 2, 3", SC 2011). Normal numbers are by Box & Muller 1958.
"""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import check_tensor
from lightfield_gs.base.checks import expect, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.stages import run_stage, select_stages


class Purpose(IntEnum):
    """The use of random numbers; the numbers of two purposes are independent."""

    NOISE = _core.NOISE_PURPOSE  # of MCMC on positions, drawn by the native update
    DROPOUT = _core.DROPOUT_PURPOSE  # drawn by the native stage as well
    INITIAL = 16  # the choice of first points, and random ones
    ORDER = 17  # of the photographs in an epoch
    BACKGROUND = 18
    DENSITY = 19  # the Gaussians that are moved, added or split, and their positions


def uniforms(seed: int, step: int, purpose: int, count: int, device: torch.device | str = "cpu") -> Tensor:
    """Return uniform numbers in [0, 1) with 53 random bits each; the same on every device.

    Args:
        seed: 0..2^64-1.
        step: 0..2^32-1.
        purpose: 0..2^32-1, see Purpose.
        count: how many.
        device: where they are made.

    Returns:
        [count] float64.

    Raises:
        InputError: a number is outside its range.
    """
    stream, out = _stream(seed, step, purpose), _empty(count, torch.float64, device)
    run_stage("uniforms", _core, out.device, *stream, count, out.data_ptr())
    return out


def normals(
    seed: int,
    step: int,
    purpose: int,
    count: int,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Tensor:
    """Return [count] numbers of mean 0 and variance 1; float32, on the CPU also float64. See uniforms."""
    stream, out = _stream(seed, step, purpose), _empty(count, dtype, device)
    run_stage("normals", select_stages("normals", out), out.device, *stream, count, out.data_ptr())
    return out


def dropout(rates: Tensor, step: Tensor, seed: int, count: int) -> Tensor:
    """Return factors of the opacities in a step: 0 for the Gaussians that it leaves out, 1 / (1 - rate) for the others.

    With few photographs some Gaussians explain only one photograph, and block the views between photographs. Each step
    draws another random subset, so that no Gaussian can hide behind others, and all get gradients. See Park et al.,
    "DropGaussian: Structural Regularization for Sparse-view Gaussian Splatting", CVPR 2025; csrc/math/fit/random.h.

    It is off by default, since the gain depends on the scene more than on the number of photographs. Of held-out
    photographs 0.1 gains -0.1 to +0.4 dB after 7,000 steps, and 0.0 to 0.2 after 30,000 (docs/benchmarks.md). Rates
    that grow to the end, as in the paper, gain more of some scenes, and lose up to 1.5 dB of others.

    Args:
        rates: [steps], each in [0, 1); float32, on the CPU also float64.
        step: one int64, read on the device, so that a CUDA graph can repeat the call for all steps. A step beyond
            `rates` leaves out nothing.
        seed: 0..2^64-1.
        count: the number of Gaussians.

    Returns:
        [count].

    Raises:
        InputError: another dtype, shape or device.
    """
    expect("rates", rates, Tensor)
    if rates.dim() != 1:
        raise InputError(f"rates must be [steps], got {list(rates.shape)}")
    stages, device = select_stages("rates", rates), rates.device
    expect("step", step, Tensor)
    check_tensor("step", step.reshape(-1), (1,), torch.int64, device)
    rates = rates.contiguous()
    factors = rates.new_empty(whole_number("count", count, 0, 2**40))
    job = stages.Dropout(
        rates=rates.data_ptr(),
        rows=len(rates),
        step=step.data_ptr(),
        seed=whole_number("seed", seed, 0, 2**64 - 1),
        count=count,
        factors=factors.data_ptr(),
    )
    run_stage("dropout", stages, device, job)
    return factors


def _stream(seed: int, step: int, purpose: int) -> tuple[int, int, int]:
    return (
        whole_number("seed", seed, 0, 2**64 - 1),
        whole_number("step", step, 0, 2**32 - 1),
        whole_number("purpose", purpose, 0, 2**32 - 1),
    )


def _empty(count: int, dtype: torch.dtype, device: torch.device | str) -> Tensor:
    return torch.empty(whole_number("count", count, 0, 2**40), dtype=dtype, device=device)
