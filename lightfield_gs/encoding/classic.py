"""The method `classic`: one dense image per view, interlaced; the usual way, and the cross-check of the others."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import to_bytes
from lightfield_gs.encoding.sorted_plan import views_shown
from lightfield_gs.encoding.views import draw_cameras
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.dense_job import Aperture
from lightfield_gs.rasterizer.images import render
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.scene.gaussians import Gaussians

_PIXELS = 4_000_000  # that are rendered at a time, so that small images go in batches


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
    """One dense image per view that the panel shows; with continuous views, one per distinct x."""
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
    """encode_classic with a graph. It keeps what the reverse of every view needs, and so is for small panels."""
    places, x = _classic_plan(panel, continuous, gaussians.device)
    order, taken = [], []
    for first in range(0, len(x), chunk := _views_at_a_time(panel)):
        cameras = rig.cameras_at(panel, x[first : first + chunk])
        images = render(gaussians, cameras, background=background, antialiased=antialiased).view(cameras.count, -1)
        mine = _shown_by(places, first, cameras.count)
        order.append(mine)
        taken.append(images[places[mine].to(torch.int64) - first, mine])
    return torch.cat(taken)[torch.cat(order).argsort()].view(panel.height_px, panel.width_px, 3)


def _views_at_a_time(panel: Panel) -> int:
    return max(1, _PIXELS // (panel.width_px * panel.height_px))


def _shown_by(places: Tensor, first: int, count: int) -> Tensor:
    """The sub-pixels [M] that images first .. first + count - 1 show."""
    return ((places >= first) & (places < first + count)).nonzero().squeeze(1)


def _take_over(out: Tensor, images: Tensor, places: Tensor, first: int) -> None:
    """Copies into out [M] the sub-pixels that the images [C, M] show, those at places first .. first + C - 1."""
    if len(images) == 1 and not out.is_cuda:  # takes half the time of what follows
        np.copyto(out.numpy(), images[0].numpy(), where=places.numpy() == first)
        return
    mine = _shown_by(places, first, len(images))
    out[mine] = images[places[mine].to(torch.int64) - first, mine]


@lru_cache(maxsize=1)  # of a panel at 8K this takes a second
def _classic_plan(panel: Panel, continuous: bool, device: torch.device) -> tuple[Tensor, np.ndarray]:
    """What views_shown returns, with the places on the device."""
    places, x = views_shown(panel, continuous)
    return torch.from_numpy(places).to(device), x
