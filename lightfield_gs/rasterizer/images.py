"""Ordinary images of Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import Colour, background_tensor, check_tensor
from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.image_operators import (
    draw_images,
    draw_images_and_splats,
    render_images_and_splats,
    render_scene,
)
from lightfield_gs.rasterizer.image_render import divide_by_alpha, draw_in_chunks
from lightfield_gs.rasterizer.operators import refuse_tangents
from lightfield_gs.scene.cameras import Cameras, recentre
from lightfield_gs.scene.gaussians import Gaussians, check_values


class RenderedImages(NamedTuple):
    """The images of `render`, a named tuple; None where a field was not asked for.

    Attributes:
        image: [..., C, H, W, 3], over the background.
        alpha: [..., C, H, W], 0..1.
        depth: [..., C, H, W], the expected view-space z of the Gaussians that cover a pixel, scene units; 0 where there
            are none.
        radii: [..., C, N], of the splats in pixels, without gradients; 0 where a Gaussian is not drawn.
    """

    image: Tensor
    alpha: Tensor | None = None
    depth: Tensor | None = None
    radii: Tensor | None = None


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
) -> RenderedImages:
    """Render ordinary images of Gaussians (Kerbl et al. 2023).

    The images are differentiable once, in the five fields of the Gaussians, the background and the cameras' poses
    (world_to_camera and world_to_camera_end).

    Args:
        gaussians: [N, ...] with cameras [C, ...]; or [B, N, ...] with cameras [B, C, ...], or with the same cameras
            [C, ...] for every set. float32 or float64.
        cameras: C cameras of any model. Those of other models than the pinhole draw each Gaussian by the model's
            Jacobian at its mean (Zwicker et al. 2001), so Gaussians of many degrees are only roughly in shape.
        background: three numbers in 0..1, or a tensor that broadcasts to [..., C, 3], whose values need only be finite.
        alpha: also return alpha.
        depth: also return depth.
        antialiased: for scenes trained with anti-aliasing (Yu et al., Mip-Splatting, 2024; gsplat's rasterize_mode).
            The blur of 0.3 px^2 widens each Gaussian, and the compensation lowers its opacity. The compensation is the
            root of the ratio of the determinants of the projected covariance without and with blur.
        screen: zeros [..., C, N, 2] that ask for gradients. The image does not depend on them. Their .grad is the
            gradient of the loss by the projected means (x right, y down), in 1 / pixels. With [..., C, N, 4] the last
            two numbers are the sums over pixels of absolute gradients (Ye et al., "AbsGS", 2024).
        radii: also return radii: half the longest extent of the region where a Gaussian's alpha is 1/255 or more.

    Returns:
        The named tuple (image, alpha, depth, radii).

    Raises:
        InputError: for arguments of other types, shapes, devices or values.
    """
    expect("gaussians", gaussians, Gaussians)
    expect("cameras", cameras, Cameras)
    for name, value in (("alpha", alpha), ("depth", depth), ("antialiased", antialiased), ("radii", radii)):
        expect(name, value, bool)
    draw = partial(_render_by_model, gaussians, alpha=alpha, depth=depth, antialiased=antialiased, radii=radii)
    if not cameras.is_all_round:
        return draw(cameras, background=background, screen=screen)
    if screen is not None:
        raise InputError("screen: equirectangular images are drawn in two halves, and have no screen: leave it out")
    return _render_all_round(draw, cameras, background)


def _render_all_round(draw_half: Callable[..., RenderedImages], cameras: Cameras, background: Colour) -> RenderedImages:
    """Return equirectangular images of two halves, 90 degrees to either side of z and of -z: a seam in the middle of a
    half would cut Gaussians in two.

    Args:
        draw_half: draws images before cameras and background.
        cameras: of the whole images.
        background: of `render`.
    """
    quarter = cast(int, cameras.width_px) // 4
    poses, centres = cameras.world_to_camera, cast(Tensor, cameras.principal_point_px)
    behind = torch.diag(poses.new_tensor([-1.0, 1, -1, 1])) @ poses
    both = replace(
        cameras.select(list(range(cameras.count)) * 2),
        world_to_camera=torch.cat([poses, behind], -3),
        principal_point_px=torch.cat([centres, centres], -2) - centres.new_tensor([quarter, 0]),
        width_px=2 * quarter,
    )
    if isinstance(background, Tensor) and background.dim() > 1 and background.shape[-2] > 1:
        background = torch.cat([background, background], -2)
    image, alpha, depth, radii = draw_half(both, background=background)

    def joined(picture: Tensor | None, columns: int, camera: int) -> Tensor | None:
        if picture is None:
            return None
        ahead, back = picture.chunk(2, camera)
        right, left = back.split(quarter, columns)
        return torch.cat([left, ahead, right], columns)

    whole = cast(Tensor, joined(image, -2, -4))
    return RenderedImages(
        whole,
        joined(alpha, -1, -3),
        joined(depth, -1, -3),
        None if radii is None else torch.maximum(*radii.chunk(2, -2)),
    )


def _render_by_model(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour,
    alpha: bool,
    depth: bool,
    antialiased: bool,
    radii: bool,
    screen: Tensor | None = None,
) -> RenderedImages:
    """Render as `render` does, each image whole."""
    gaussians.validate_layout()
    if not gaussians.means.is_cuda:
        check_values(gaussians)  # on CUDA looking at values would wait for the device
    like, *others = gaussians.fields().values()
    refuse_tangents(like, *others, background, *cameras.ends().values())
    if torch.is_grad_enabled() and any(t.requires_grad for t in (cameras.intrinsics(), cameras.limits())):
        raise InputError(
            "cameras: focal_px and principal_point_px (K) and jacobian_limits have no gradients, and one of them "
            "requires it: detach() it, or use torch.no_grad()"
        )
    batched = like.dim() == 3
    shared = cameras.world_to_camera.dim() == 3  # by all sets of a batch
    if not shared and not batched:
        raise InputError(
            f"cameras [B, C, ...] go with batched Gaussians [B, N, ...], got means {list(like.shape)} and "
            f"cameras {list(cameras.world_to_camera.shape)}"
        )
    means, cameras = recentre(like, cameras)
    views = [t.to(like) for t in (cameras.poses(), cameras.intrinsics(), cameras.limits())]
    if shared:
        views = [t.expand(like.shape[0] if batched else 1, *t.shape) for t in views]
    colour = background_tensor(background, like).expand(*views[0].shape[:2], 3)
    fields = (means, *others)
    options: list[Any] = [cameras.width_px, cameras.height_px, antialiased]
    model = cameras.model_number
    if screen is not None:
        screen = _checked_screen(screen, gaussians, cameras.count)
    asked = screen is not None or any(t.requires_grad for t in (*fields, colour, *views))
    with_gradients = torch.is_grad_enabled() and asked
    if not with_gradients and not radii and not batched:
        batch = [field.unsqueeze(0) for field in fields]
        asked_for: dict[str, Any] = {"alpha": alpha or depth, "depth": depth, "model": model}
        drawn = draw_in_chunks(batch, colour, views, *options, **asked_for)
        if drawn.depth is not None and drawn.alpha is not None:
            divide_by_alpha(drawn.depth, drawn.alpha)
        return _of_one_scene(RenderedImages(drawn.image, drawn.alpha if alpha else None, drawn.depth))
    splats: list[Tensor] = []
    if with_gradients and not radii and not batched:
        image, coverage, weighted_depth = render_scene(fields, colour, (*views,), (*options, screen, model))
    else:
        draw: Callable[..., tuple[Tensor, ...]]
        if with_gradients:
            draw = render_images_and_splats if radii else torch.ops.lightfield_gs.render_images
        else:  # at the first call of an operator with a backward torch spends a second on imports
            draw = draw_images_and_splats if radii else draw_images
        batch = list(fields) if batched else [field.unsqueeze(0) for field in fields]
        image, coverage, weighted_depth, *splats = draw(*batch, colour, *views, *options, screen, model)
    images = RenderedImages(
        image,
        coverage if alpha else None,
        weighted_depth / coverage.clamp_min(1e-10) if depth else None,
        splat_radii(splats[0]).view(*coverage.shape[:2], gaussians.count) if radii else None,
    )
    return images if batched else _of_one_scene(images)


def _of_one_scene(images: RenderedImages) -> RenderedImages:
    """Remove the leading dimension of a batch of one scene."""
    image, *others = images
    return RenderedImages(image.squeeze(0), *(None if t is None else t.squeeze(0) for t in others))


def _checked_screen(screen: Tensor, gaussians: Gaussians, cameras: int) -> Tensor:
    """Return the argument `screen` of render as [B, C, N, 2 or 4]. Raises InputError."""
    expect("screen", screen, Tensor)
    shape = [*gaussians.means.shape[:-2], cameras, gaussians.count]
    if list(screen.shape[:-1]) != shape or screen.shape[-1] not in (2, 4):
        raise InputError(f"screen: expected {shape} of 2 or 4 numbers, got {list(screen.shape)}")
    check_tensor("screen", screen, screen.shape, gaussians.dtype, gaussians.device)
    if not screen.requires_grad:
        raise InputError("screen: nothing but its gradient means anything; make it with requires_grad=True")
    return screen if gaussians.is_batched else screen.unsqueeze(0)


def splat_radii(splats: Tensor) -> Tensor:
    """Return half the longest extent of the region that each splat covers, [...] in pixels; 0 where it is not drawn.

    The region is where its alpha is 1/255 or more.

    Args:
        splats: [..., SPLAT_FIELDS], in conditional form (csrc/math/projection.h). In units of log2 the inverse
            covariance is [[1/S, -c0/S], [-c0/S, tau + c0^2/S]], so the covariance is [[S + c0^2/tau, c0/tau], [c0/tau,
            1/tau]].
    """
    log2_opacity, square, tau, c0 = (splats[..., k] for k in _core.SPLAT_SHAPE_INDICES)
    down = 1 / tau
    across = square + c0 * c0 * down
    middle = (across + down) / 2
    longest = middle + torch.sqrt(((across - down) / 2).square() + (c0 * down).square())
    radii = torch.sqrt(longest * (log2_opacity - _core.LOG2_MIN_ALPHA).clamp_min(0))
    return torch.where(splats[..., _core.SPLAT_REACH_INDEX] >= 0, radii, torch.zeros_like(radii))
