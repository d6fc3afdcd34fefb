"""How the views of a fit are drawn: without autograd, and with nothing to wait for."""

from __future__ import annotations

from torch import Tensor

from lightfield_gs.fitting.views import Views
from lightfield_gs.rasterizer.image_render import ImageArguments, ImageRender
from lightfield_gs.scene.gaussians import Gaussians


def view_job(
    gaussians: Gaussians,
    views: Views,
    chosen: Tensor,
    world_to_camera: Tensor,
    background: Tensor,
    antialiased: bool,
    *,
    room: int | None = None,
    size_px: tuple[int, int] | None = None,
) -> ImageRender:
    """The job that draws the views `chosen` [V] of C, from the poses world_to_camera [C,4,4], over background [V,3].

    room: for how many (tile, splat) pairs, on CUDA; None: the host waits for their number. size_px: width and height of
    the upper left part that is drawn; None: all.
    """
    width, height = size_px or (views.width_px, views.height_px)
    poses, intrinsics, limits = (
        tensor.index_select(0, chosen)[None] for tensor in (world_to_camera, views.intrinsics, views.limits)
    )
    means, quaternions, scales, opacities, sh = (field[None] for field in gaussians.fields().values())
    arguments = ImageArguments(
        means,
        quaternions,
        scales,
        opacities,
        sh,
        background[None],
        poses,
        intrinsics,
        limits,
        width,
        height,
        antialiased,
    )
    return ImageRender.from_arguments(arguments, capacity=room)
