"""Ordinary pictures of the cameras of a rig, as the panel's views are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour
from lightfield_gs.base.checks import expect
from lightfield_gs.encoding.arguments import check_view_filter
from lightfield_gs.panels.lens import view_aperture
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.background import background_tensor
from lightfield_gs.rasterizer.dense_job import Aperture
from lightfield_gs.rasterizer.dense_parts import dense_in_parts
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.scene.cameras import Cameras, about_cameras
from lightfield_gs.scene.gaussians import Gaussians


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
) -> Tensor:
    """Pictures [K, H, W, 3] of the cameras at the view coordinates x [K] of a panel, of its size, without
    gradients. antialiased, view_filter: see `encode`. Raises InputError."""
    expect("gaussians", gaussians, Gaussians)
    expect("antialiased", antialiased, bool)
    gaussians.validate_layout()
    if not gaussians.means.is_cuda:
        gaussians.validate()  # on CUDA looking at values would wait for the device
    aperture = view_aperture(panel, rig, check_view_filter(view_filter))
    colour = background_tensor(background, gaussians.means)
    return draw_cameras(gaussians, rig.cameras_at(panel, x), colour, antialiased, aperture)[0]


def draw_cameras(
    gaussians: Gaussians,
    cameras: Cameras,
    background: Tensor,
    antialiased: bool,
    aperture: Aperture,
    stats: Stats | None = None,
    threads: int | None = None,
) -> Tensor:
    """Image [1, K, H, W, 3] of one scene before cameras [K], unchecked and without gradients. background: what
    broadcasts to [1, K, 3]."""
    means, cameras = about_cameras(gaussians.means, cameras)
    cameras = cameras.to(gaussians.means)
    _, *others = gaussians.fields().values()
    return dense_in_parts(
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
