"""Ordinary images of Gaussians, and what they are drawn over."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Literal, overload

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, dense_tensor
from lightfield_gs.base.checks import expect, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.dense import dense_forward
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians


@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[False] = ...,
    depth: Literal[False] = ...,
    antialiased: bool = ...,
) -> Tensor: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[True],
    depth: Literal[False] = ...,
    antialiased: bool = ...,
) -> tuple[Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[False] = ...,
    depth: Literal[True],
    antialiased: bool = ...,
) -> tuple[Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[True],
    depth: Literal[True],
    antialiased: bool = ...,
) -> tuple[Tensor, Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: bool = ...,
    depth: bool = ...,
    antialiased: bool = ...,
) -> Tensor | tuple[Tensor, ...]: ...
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    alpha: bool = False,
    depth: bool = False,
    antialiased: bool = False,
) -> Tensor | tuple[Tensor, ...]:
    """Ordinary images of Gaussians (Kerbl et al. 2023), differentiable.

    gaussians [N, ...] with cameras [C, ...]; or gaussians [B, N, ...] with cameras [B, C, ...], or with the same
    cameras [C, ...] for every set. float32 or float64.
    background: three numbers in 0..1, or a tensor that broadcasts to [..., C, 3], whose values need only be finite.
    Returns the image [..., C, H, W, 3]; with alpha and/or depth a tuple (image, alpha [..., C, H, W], depth
    [..., C, H, W]), depth being the expected view-space z of what is covered, 0 where nothing is.
    antialiased: for scenes that were trained so (Yu et al., Mip-Splatting, 2024; gsplat's rasterize_mode of that name):
    a Gaussian that 0.3 px^2 of blur spread out becomes fainter by as much, by the root of the ratio of the determinants
    of its projected covariance. Raises InputError.
    """
    expect("gaussians", gaussians, Gaussians)
    expect("cameras", cameras, Cameras)
    for name, value in (("alpha", alpha), ("depth", depth), ("antialiased", antialiased)):
        expect(name, value, bool)
    gaussians.validate_layout()
    if not gaussians.means.is_cuda:
        gaussians.validate()  # on CUDA looking at values would wait for the device
    like, batched = gaussians.means, gaussians.is_batched
    views = [t.to(like) for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())]
    if cameras.world_to_camera.dim() == 3:
        views = [t.expand(like.shape[0] if batched else 1, *t.shape) for t in views]
    elif not batched:
        raise InputError(
            f"cameras [B, C, ...] go with batched Gaussians [B, N, ...], got means {list(like.shape)} and "
            f"cameras {list(cameras.world_to_camera.shape)}"
        )
    tensors = [t if batched else t.unsqueeze(0) for t in gaussians.fields().values()]
    colour = background_tensor(background, like).expand(*views[0].shape[:2], 3)
    draw: Callable[..., tuple[Tensor, Tensor, Tensor]] = torch.ops.lightfield_gs.render_dense
    if not (torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors, colour, *views))):
        draw = dense_forward  # at the first call of an operator with a reverse torch spends a second on imports
    image, coverage, weighted_depth = draw(*tensors, colour, *views, cameras.width_px, cameras.height_px, antialiased)
    out = [image]
    if alpha:
        out.append(coverage)
    if depth:
        out.append(weighted_depth / coverage.clamp_min(1e-10))
    out = [t if batched else t.squeeze(0) for t in out]
    return tuple(out) if len(out) > 1 else out[0]


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
        plain, background = False, dense_tensor("background", background)
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
