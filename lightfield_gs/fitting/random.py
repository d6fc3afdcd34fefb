"""Random numbers that are a function of what they are for: seed, step, purpose and index (csrc/math/fit/random.h).

Nothing has to be stored to go on from a checkpoint, and every run draws the same, on any device; normal numbers are
equal up to the rounding of the logarithm, the root, the sine and the cosine. They are those of Philox4x32-10, Salmon et
al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011; normal ones by Box & Muller 1958.
"""

from __future__ import annotations

from enum import IntEnum

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.cuda import device_guard
from lightfield_gs.fitting.native import core_of, stream_of


class Purpose(IntEnum):
    """What random numbers are drawn for: those of one purpose have nothing to do with those of another."""

    NOISE = _core.NOISE_PURPOSE  # of MCMC on positions, drawn by the update itself
    DROPOUT = _core.DROPOUT_PURPOSE  # of which Gaussians a step leaves out, drawn by the native stage as well
    INITIAL = 16  # which points a fit begins with, and where random ones are
    ORDER = 17  # of the photographs in an epoch
    BACKGROUND = 18
    DENSITY = 19  # which Gaussians are moved, added or split, and where to


def uniforms(seed: int, step: int, purpose: int, count: int, device: torch.device | str = "cpu") -> Tensor:
    """[count] float64 in [0, 1), of 53 random bits each; the same on every device.

    seed: 0..2^64-1. step, purpose: 0..2^32-1; see Purpose. Raises InputError for numbers outside these.
    """
    stream, out = _stream(seed, step, purpose), _empty(count, torch.float64, device)
    with device_guard(out.device):
        if out.is_cuda:
            _core.cuda.uniforms(*stream, count, out.data_ptr(), stream_of(out.device))
        else:
            _core.uniforms(*stream, count, out.data_ptr(), torch.get_num_threads())
    return out


def normals(
    seed: int,
    step: int,
    purpose: int,
    count: int,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Tensor:
    """[count] numbers of mean 0 and variance 1; float32, on the CPU also float64. See uniforms."""
    stream, out = _stream(seed, step, purpose), _empty(count, dtype, device)
    core = core_of("normals", out)
    with device_guard(out.device):
        if out.is_cuda:
            _core.cuda.normals(*stream, count, out.data_ptr(), stream_of(out.device))
        else:
            core.normals(*stream, count, out.data_ptr(), torch.get_num_threads())
    return out


def _stream(seed: int, step: int, purpose: int) -> tuple[int, int, int]:
    return (
        whole_number("seed", seed, 0, 2**64 - 1),
        whole_number("step", step, 0, 2**32 - 1),
        whole_number("purpose", purpose, 0, 2**32 - 1),
    )


def _empty(count: int, dtype: torch.dtype, device: torch.device | str) -> Tensor:
    return torch.empty(whole_number("count", count, 0, 2**40), dtype=dtype, device=device)
