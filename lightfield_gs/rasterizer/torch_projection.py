"""Projection by torch, for what the native one does not take: covariances, and another blur than 0.3 px^2.

The formulas are those of csrc/math/projection.h, in float64; autograd has the gradients.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.harmonics import harmonics, rotations
from lightfield_gs.base.options import CAMERA_MODELS
from lightfield_gs.rasterizer.splat_shapes import is_drawn

_HALF_LOG2E = 0.5 / math.log(2)
MODELS = ("pinhole", "orthographic")  # that have Jacobians here


def covariances(quaternions: Tensor, scales: Tensor) -> Tensor:
    """Return covariances [..., 3, 3] of Gaussians with quaternions [..., 4] (wxyz) and scales [..., 3]."""
    factors = rotations(quaternions) * scales.unsqueeze(-2)
    return factors @ factors.mT


def project(
    means: Tensor,
    covars: Tensor,
    opacities: Tensor,
    cameras: Sequence[Tensor],
    size: tuple[int, int],
    model: int,
    blur: float,
    antialiased: bool,
) -> Tensor:
    """Return splats [B, V, N, SPLAT_FIELDS] (csrc/math/projection.h) of the dtype of the means.

    Args:
        means: [B, N, 3].
        covars: [B, N, 3, 3].
        opacities: [B, N].
        cameras: world_to_camera, intrinsics and limits, see ImageArguments.
        size: width and height of the images, pixels.
        model: of the cameras, one of MODELS.
        blur: variance that is added to the diagonal of projected covariances, px^2.
        antialiased: whether opacities are compensated for the blur.
    """
    poses, intrinsics, limits = (t.double() for t in cameras)
    rotation, translation = poses[..., :3, :3], poses[..., :3, 3]
    x, y, depth = (torch.einsum("bvij,bnj->bvni", rotation, means.double()) + translation.unsqueeze(2)).unbind(-1)
    drawn = (depth >= _core.NEAR_DEPTH) & (opacities.unsqueeze(1) * 255 >= 1)
    z, opacity = torch.where(drawn, depth, 1), torch.where(drawn, opacities.double().unsqueeze(1), 1)
    fx, fy, cx, cy = intrinsics.unsqueeze(2).unbind(-1)
    zero = torch.zeros_like(z)
    if CAMERA_MODELS[model] == "orthographic":
        u, v, across, down = fx * x + cx, fy * y + cy, (fx + zero, zero, zero), (zero, fy + zero, zero)
    else:
        low_x, high_x, low_y, high_y, offset = limits.unsqueeze(2).unbind(-1)
        slope_x = torch.minimum(torch.maximum((x + offset) / z, low_x), high_x) - offset / z
        slope_y = torch.minimum(torch.maximum(y / z, low_y), high_y)
        u, v = fx * x / z + cx, fy * y / z + cy
        across, down = (fx / z, zero, -fx * slope_x / z), (zero, fy / z, -fy * slope_y / z)
    jacobian = torch.stack([torch.stack(across, -1), torch.stack(down, -1)], -2) @ rotation.unsqueeze(2)
    exact = covars.double().unsqueeze(1)
    on_screen = jacobian @ ((exact + exact.mT) / 2) @ jacobian.mT
    xx, xy, yy = on_screen[..., 0, 0], on_screen[..., 0, 1], on_screen[..., 1, 1]

    # The conditional form, and the compensation of its opacity
    tall = torch.where(drawn, yy + blur, 1)
    square = torch.where(drawn, xx + blur - xy * xy / tall, 1)
    drawn = drawn & (tall > 0) & (square > 0)
    log2_opacity = opacity.log2()
    if antialiased:
        ratio = (xx * yy - xy * xy) / (tall * square)
        drawn = drawn & (ratio > 0)
        log2_opacity = log2_opacity + torch.where(drawn, ratio, 1).log2() / 2
    tau, slope = _HALF_LOG2E / torch.where(drawn, tall, 1), xy / torch.where(drawn, tall, 1)
    numbers = {0: u, 2: v, 3: log2_opacity, 4: square / _HALF_LOG2E, 7: tau, 8: slope, 11: depth}
    with torch.no_grad():
        left = log2_opacity - _core.LOG2_MIN_ALPHA
        wide, high = (((t + blur) / _HALF_LOG2E * left).clamp_min(0).sqrt() for t in (xx, yy))
        inside = (u + wide >= 0) & (u - wide <= size[0]) & (v + high >= 0) & (v - high <= size[1])
        reach = torch.where(drawn & inside & (left >= 0), (left.clamp_min(0) / tau).sqrt(), -1)
    numbers[_core.SPLAT_REACH_INDEX] = reach
    splats = torch.stack([numbers.get(k, zero) for k in range(_core.SPLAT_FIELDS)], -1).to(means.dtype)
    return torch.where(is_drawn(splats).unsqueeze(-1), splats, splats.new_full((), -1))


def colours(means: Tensor, sh: Tensor, world_to_camera: Tensor) -> Tensor:
    """Return the colours of Gaussians before each camera, [B, V, N, 3], not below zero.

    Args:
        means: [B, N, 3].
        sh: [B, N, K, 3].
        world_to_camera: [B, V, 4, 4].
    """
    rotation, translation = world_to_camera[..., :3, :3], world_to_camera[..., :3, 3:]
    directions = torch.nn.functional.normalize(means.unsqueeze(1) + (rotation.mT @ translation).mT, dim=-1)
    basis = harmonics(directions, sh.shape[-2])
    return (0.5 + (basis.unsqueeze(-1) * sh.unsqueeze(1)).sum(-2)).clamp_min(0)
