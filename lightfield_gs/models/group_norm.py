"""Group normalisation and SiLU of the U-Net, Wu & He, ECCV 2018: PyTorch's, or one CUDA kernel of ours."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lightfield_gs import _core


def group_norm_silu(norm: nn.GroupNorm, features: Tensor) -> Tensor:
    """silu(norm(features)), features [B,C,H,W].

    Our kernel is for inference in bfloat16 on CUDA with channels last, for which PyTorch takes six kernels, two of them
    copies to channels first and back. It rounds once, where PyTorch rounds twice.
    """
    if not _is_ours(norm, features):
        return F.silu(norm(features))
    batch, channels, height, width = features.shape
    out = torch.empty_like(features)
    with torch.cuda.device_of(features):
        _core.cuda.group_norm_silu(
            batch,
            height * width,
            channels,
            norm.num_groups,
            features.data_ptr(),
            norm.weight.data_ptr(),
            norm.bias.data_ptr(),
            norm.eps,
            out.data_ptr(),
            torch.cuda.current_stream().cuda_stream,
        )
    return out


def _is_ours(norm: nn.GroupNorm, features: Tensor) -> bool:
    if torch.compiler.is_compiling() or torch.is_grad_enabled() or not (features.is_cuda and hasattr(_core, "cuda")):
        return False
    return (
        features.dtype == norm.weight.dtype == torch.bfloat16
        and features.is_contiguous(memory_format=torch.channels_last)
        and norm.num_channels % (2 * norm.num_groups) == 0
    )
