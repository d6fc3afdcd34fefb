"""Ordinary images of a rig's cameras, and the method `classic`, which interlaces one image for each view."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, background_tensor, to_bytes, to_tensor
from lightfield_gs.base.checks import expect, real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.sorted_plan import views_shown
from lightfield_gs.panels.panel import MAX_VIEWS, Panel
from lightfield_gs.panels.rig import Rig, view_aperture
from lightfield_gs.rasterizer.image_render import draw_in_chunks
from lightfield_gs.rasterizer.images import render
from lightfield_gs.rasterizer.lenticular_camera import PINHOLE, Aperture
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.scene.cameras import Cameras, recentre
from lightfield_gs.scene.gaussians import Gaussians, check_values
from lightfield_gs.webgpu.devices import check_on_cpu
from lightfield_gs.webgpu.views import draw_views


@torch.no_grad()
def render_views(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    x: Sequence[float] | np.ndarray,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    view_filter: float = 0.0,
    device: str | None = None,
) -> Tensor:
    """Render images [K, H, W, 3] of the panel's size from the cameras of a rig, without gradients.

    Args:
        gaussians: one scene.
        panel: of whose views x counts.
        rig: of the cameras.
        x: [K], view coordinates of the cameras.
        background: see `encode`, also for antialiased, view_filter and device.

    Raises:
        InputError: for arguments of other types or values.
    """
    aperture = view_aperture(panel, rig, real_number("view_filter (views)", view_filter, 0.0, MAX_VIEWS))
    cameras = rig.cameras_at(panel, x)
    return render_cameras(
        gaussians, cameras, background=background, antialiased=antialiased, aperture=aperture, device=device
    )


@torch.no_grad()
def render_cameras(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    aperture: Aperture = PINHOLE,
    device: str | None = None,
) -> Tensor:
    """Render images [K, H, W, 3] of cameras, without gradients.

    Args:
        gaussians: one scene.
        cameras: [K], pinholes.
        background: see `encode`, also for antialiased and device.
        aperture: of each camera.

    Raises:
        InputError: for arguments of other types or values.
    """
    expect("gaussians", gaussians, Gaussians)
    expect("antialiased", antialiased, bool)
    gaussians.validate_layout()
    if not gaussians.means.is_cuda:
        check_values(gaussians)  # on CUDA looking at values would wait for the device
    colour = background_tensor(background, gaussians.means)
    if device is not None:
        expect("device", device, str)
        check_on_cpu(device, gaussians)
        gaussians = gaussians.to(dtype=torch.float32)
        return draw_views(device, gaussians, cameras, colour.reshape(-1).float(), antialiased, aperture)
    return draw_cameras(gaussians, cameras, colour, antialiased, aperture)[0]


def draw_cameras(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor,
    antialiased: bool,
    aperture: Aperture,
    stats: Stats | None = None,
    threads: int | None = None,
) -> Tensor:
    """Draw one scene before cameras [K], unchecked and without gradients.

    Args:
        background: Broadcasts to [1, K, 3].

    Returns:
        The image [1, K, H, W, 3].
    """
    means, cameras = recentre(gaussians.means, cameras)
    cameras = cameras.to(gaussians.means)
    _, *others = gaussians.fields().values()
    return draw_in_chunks(
        [field.unsqueeze(0) for field in (means, *others)],
        background.expand(1, cameras.count, 3),
        [t[None] for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())],
        cast(int, cameras.width_px),
        cast(int, cameras.height_px),
        antialiased,
        stats=stats,
        threads=threads,
        aperture=aperture,
    ).image


_PIXELS = 4_000_000  # rendered at a time, so that small images form batches


@torch.no_grad()
def encode_classic(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    continuous: bool,
    background: Tensor,
    dtype: torch.dtype,
    threads: int | None,
    stats: Stats,
    antialiased: bool,
    aperture: Aperture,
) -> Tensor:
    """Draw one image per view that the panel shows, and interlace them; continuous views: one per distinct x."""
    with stats.stage("plan"):
        places, x = _classic_plan(panel, continuous, gaussians.device)
    pixels = panel.width_px * panel.height_px
    out = torch.empty(3 * pixels, dtype=dtype, device=gaussians.device)
    chunk = _views_at_a_time(panel)
    for first in range(0, len(x), chunk):
        cameras = rig.cameras_at(panel, x[first : first + chunk])
        one = Stats(device=stats.device)
        images = draw_cameras(gaussians, cameras, background, antialiased, aperture, one, threads)
        one.add_buffers(images)
        stats.add_render(one)
        with stats.stage("interlace"):
            if dtype == torch.uint8:
                images = to_bytes(images)
            _take_over(out, images.view(cameras.count, -1), places, first)
    return out.view(panel.height_px, panel.width_px, 3)


def classic_with_gradients(
    gaussians: Gaussians, panel: Panel, rig: Rig, continuous: bool, background: Tensor, antialiased: bool
) -> Tensor:
    """Return encode_classic's image with a graph. It keeps every view's state for the backward: for small panels."""
    places, x = _classic_plan(panel, continuous, gaussians.device)
    order, taken = [], []
    for first in range(0, len(x), chunk := _views_at_a_time(panel)):
        cameras = rig.cameras_at(panel, x[first : first + chunk])
        images = render(gaussians, cameras, background=background, antialiased=antialiased).image.view(
            cameras.count, -1
        )
        mine = _shown_by(places, first, cameras.count)
        order.append(mine)
        taken.append(images[places[mine].to(torch.int64) - first, mine])
    return torch.cat(taken)[torch.cat(order).argsort()].view(panel.height_px, panel.width_px, 3)


def _views_at_a_time(panel: Panel) -> int:
    return max(1, _PIXELS // (panel.width_px * panel.height_px))


def _shown_by(places: Tensor, first: int, count: int) -> Tensor:
    """Return the sub-pixels [M] that images first .. first + count - 1 show."""
    return ((places >= first) & (places < first + count)).nonzero().squeeze(1)


def _take_over(out: Tensor, images: Tensor, places: Tensor, first: int) -> None:
    """Copy into out [M] the sub-pixels that the images [C, M] show, at places first .. first + C - 1."""
    if len(images) == 1 and not out.is_cuda:  # takes half the time of what follows
        np.copyto(out.numpy(), images[0].numpy(), where=places.numpy() == first)
        return
    mine = _shown_by(places, first, len(images))
    out[mine] = images[places[mine].to(torch.int64) - first, mine]


@lru_cache(maxsize=1)  # of a panel at 8K this takes a second
def _classic_plan(panel: Panel, continuous: bool, device: torch.device) -> tuple[Tensor, np.ndarray]:
    """Return what views_shown returns, with the places on the device."""
    places, x = views_shown(panel, continuous)
    return torch.from_numpy(places).to(device), x


def interlace(views: Tensor, panel: Panel) -> Tensor:
    """Take every sub-pixel of a panel from its view: views [N, H, W, 3] -> [H, W, 3], same dtype.

    Args:
        views: as many as the panel has, of its size. View 0 is for the right-most eye, with invert_views for the
            left-most eye. Tiles of a quilt have the opposite order.
        panel: says which view each sub-pixel shows.

    Raises:
        InputError: number or size of the views differ from the panel's.
    """
    views = to_tensor("views", views)
    expect("panel", panel, Panel)
    expected = (panel.views, panel.height_px, panel.width_px, 3)
    if tuple(views.shape) != expected:
        raise InputError(f"views must be {list(expected)} for this panel, got {list(views.shape)}")
    numbers = torch.from_numpy(panel.view_map()).to(device=views.device, dtype=torch.int64)
    return views.gather(0, numbers.unsqueeze(0)).squeeze(0)
