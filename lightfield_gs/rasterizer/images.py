"""Ordinary images of Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, overload

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import Colour
from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.autograd import refuse_tangents
from lightfield_gs.rasterizer.image_operator import (
    dense_forward,
    dense_forward_with_splats,
    dense_with_splats,
    render_scene,
)
from lightfield_gs.rasterizer.image_render import DenseImages, dense_in_parts, divide_by_alpha
from lightfield_gs.rasterizer.scene import background_tensor
from lightfield_gs.scene.cameras import Cameras, about_cameras
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
    screen: Tensor | None = ...,
    radii: Literal[False] = ...,
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
    screen: Tensor | None = ...,
    radii: Literal[False] = ...,
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
    screen: Tensor | None = ...,
    radii: Literal[False] = ...,
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
    screen: Tensor | None = ...,
    radii: Literal[False] = ...,
) -> tuple[Tensor, Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[False] = ...,
    depth: Literal[False] = ...,
    antialiased: bool = ...,
    screen: Tensor | None = ...,
    radii: Literal[True],
) -> tuple[Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[True],
    depth: Literal[False] = ...,
    antialiased: bool = ...,
    screen: Tensor | None = ...,
    radii: Literal[True],
) -> tuple[Tensor, Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[False] = ...,
    depth: Literal[True],
    antialiased: bool = ...,
    screen: Tensor | None = ...,
    radii: Literal[True],
) -> tuple[Tensor, Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[True],
    depth: Literal[True],
    antialiased: bool = ...,
    screen: Tensor | None = ...,
    radii: Literal[True],
) -> tuple[Tensor, Tensor, Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: bool = ...,
    depth: bool = ...,
    antialiased: bool = ...,
    screen: Tensor | None = ...,
    radii: bool = ...,
) -> Tensor | tuple[Tensor, ...]: ...
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    alpha: bool = False,
    depth: bool = False,
    antialiased: bool = False,
    screen: Tensor | None = None,
    radii: bool = False,
) -> Tensor | tuple[Tensor, ...]:
    """Ordinary images of Gaussians (Kerbl et al. 2023), differentiable once in the five fields of the Gaussians, the
    background and cameras.world_to_camera.

    gaussians [N, ...] with cameras [C, ...]; or gaussians [B, N, ...] with cameras [B, C, ...], or with the same
    cameras [C, ...] for every set. float32 or float64.
    background: three numbers in 0..1, or a tensor that broadcasts to [..., C, 3], whose values need only be finite.
    Returns the image [..., C, H, W, 3]; with alpha and/or depth a tuple (image, alpha [..., C, H, W], depth
    [..., C, H, W]), depth being the expected view-space z of what is covered, 0 where nothing is.
    antialiased: for scenes that were trained so (Yu et al., Mip-Splatting, 2024; gsplat's rasterize_mode of that name):
    a Gaussian that 0.3 px^2 of blur spread out becomes fainter by as much, by the root of the ratio of the determinants
    of its projected covariance.
    screen: zeros [..., C, N, 2] that ask for gradients. The image does not depend on them, but their .grad is that of
    the loss by the projected means (x right, y down), in 1 / pixels. [..., C, N, 4]: the last two are then sums over
    pixels of the absolute values of what each adds to it (Ye et al., "AbsGS", 2024).
    radii: returns, as the last of the tuple, [..., C, N] in pixels, without gradients: half the longest extent of where
    a Gaussian's alpha is 1/255 or more; 0 where it is not drawn. Raises InputError.
    """
    expect("gaussians", gaussians, Gaussians)
    expect("cameras", cameras, Cameras)
    for name, value in (("alpha", alpha), ("depth", depth), ("antialiased", antialiased), ("radii", radii)):
        expect(name, value, bool)
    gaussians.validate_layout()
    if not gaussians.means.is_cuda:
        gaussians.validate()  # on CUDA looking at values would wait for the device
    refuse_tangents(*gaussians.fields().values(), background, cameras.world_to_camera)
    if torch.is_grad_enabled() and any(t.requires_grad for t in (cameras.intrinsics(), cameras.limits())):
        raise InputError(
            "cameras: focal_px and principal_point_px (K) and jacobian_limits have no gradients, and one of them "
            "requires it: detach() it, or use torch.no_grad()"
        )
    like, batched = gaussians.means, gaussians.is_batched
    together = cameras.world_to_camera.dim() == 3
    if not together and not batched:
        raise InputError(
            f"cameras [B, C, ...] go with batched Gaussians [B, N, ...], got means {list(like.shape)} and "
            f"cameras {list(cameras.world_to_camera.shape)}"
        )
    means, cameras = about_cameras(like, cameras)
    views = [t.to(like) for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())]
    if together:
        views = [t.expand(like.shape[0] if batched else 1, *t.shape) for t in views]
    colour = background_tensor(background, like).expand(*views[0].shape[:2], 3)
    fields = (means, *tuple(gaussians.fields().values())[1:])
    options: list[Any] = [cameras.width_px, cameras.height_px, antialiased]
    if screen is not None:
        screen = _checked_screen(screen, gaussians, cameras.count)
    needs_gradients = screen is not None or any(t.requires_grad for t in (*fields, colour, *views))
    splats: list[Tensor] = []
    if not (torch.is_grad_enabled() and needs_gradients) and not radii and not batched:
        drawn = dense_in_parts(
            [field.unsqueeze(0) for field in fields], colour, views, *options, alpha=alpha or depth, depth=depth
        )
        return _asked_for(drawn, alpha)
    if torch.is_grad_enabled() and needs_gradients and not radii and not batched:
        image, coverage, weighted_depth = render_scene(fields, colour, (*views,), (*options, screen))
    else:
        draw: Callable[..., tuple[Tensor, ...]]
        if torch.is_grad_enabled() and needs_gradients:
            draw, options = dense_with_splats if radii else torch.ops.lightfield_gs.render_dense, [*options, screen]
        else:  # at the first call of an operator with a reverse torch spends a second on imports
            draw = dense_forward_with_splats if radii else dense_forward
        batch = fields if batched else [field.unsqueeze(0) for field in fields]
        image, coverage, weighted_depth, *splats = draw(*batch, colour, *views, *options)
    out = [image]
    if alpha:
        out.append(coverage)
    if depth:
        out.append(weighted_depth / coverage.clamp_min(1e-10))
    if radii:
        out.append(radii_px(splats[0]).view(*coverage.shape[:2], gaussians.count))
    out = [t if batched else t.squeeze(0) for t in out]
    return tuple(out) if len(out) > 1 else out[0]


def _asked_for(drawn: DenseImages, alpha: bool) -> Tensor | tuple[Tensor, ...]:
    """What render returns of one scene's images without gradients; depth has been drawn only if it was asked for."""
    image, coverage, depth = drawn
    out = [image.squeeze(0)]
    if alpha and coverage is not None:
        out.append(coverage.squeeze(0))
    if depth is not None and coverage is not None:
        out.append(divide_by_alpha(depth, coverage).squeeze(0))
    return tuple(out) if len(out) > 1 else out[0]


def _checked_screen(screen: Tensor, gaussians: Gaussians, cameras: int) -> Tensor:
    """The argument `screen` of render, [B, C, N, 2 or 4]. Raises InputError."""
    expect("screen", screen, Tensor)
    shape = [*gaussians.means.shape[:-2], cameras, gaussians.count]
    if list(screen.shape[:-1]) != shape or screen.shape[-1] not in (2, 4):
        raise InputError(f"screen: expected {shape} of 2 or 4 numbers, got {list(screen.shape)}")
    if screen.dtype != gaussians.dtype or screen.device != gaussians.device:
        raise InputError(
            f"screen: expected {gaussians.dtype} on {gaussians.device} as means, got {screen.dtype} on {screen.device}"
        )
    if not screen.requires_grad:
        raise InputError("screen: nothing but its gradient means anything; make it with requires_grad=True")
    return screen if gaussians.is_batched else screen.unsqueeze(0)


def radii_px(splats: Tensor) -> Tensor:
    """Half the longest extent of what each splat [..., SPLAT_FIELDS] covers, [...] in pixels; 0 where not drawn.

    That is where its alpha is 1/255 or more. A splat is stored in conditional form (csrc/math/projection.h): in units
    of log2 its inverse covariance is [[1/S, -c0/S], [-c0/S, tau + c0^2/S]], so its covariance [[S + c0^2/tau, c0/tau],
    [c0/tau, 1/tau]].
    """
    log2_opacity, square, tau, c0 = (splats[..., k] for k in _core.SPLAT_SHAPE_INDICES)
    down = 1 / tau
    across = square + c0 * c0 * down
    middle = (across + down) / 2
    longest = middle + torch.sqrt(((across - down) / 2).square() + (c0 * down).square())
    radii = torch.sqrt(longest * (log2_opacity - _core.LOG2_MIN_ALPHA).clamp_min(0))
    return torch.where(splats[..., _core.SPLAT_REACH_INDEX] >= 0, radii, torch.zeros_like(radii))
