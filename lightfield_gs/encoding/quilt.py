"""A scene to a quilt: one picture for each view of a fan, side by side in one image."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, to_bytes
from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.classic import render_views
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.quilt import QuiltLayout
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.gaussians import Gaussians

_PIXELS = 4_000_000  # rendered at a time, so that small views form batches
_COVERED = 0.5  # alpha from which on a pixel has a depth


@torch.no_grad()
def quilt(
    gaussians: Gaussians,
    layout: QuiltLayout,
    rig: Rig,
    panel: Panel | None = None,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    view_filter: float = 0.0,
    device: str | None = None,
) -> Tensor:
    """Draw the quilt uint8 [H, W, 3] of a scene: one view of the rig's fan in each tile, the left-most bottom left.

    Args:
        gaussians: one scene.
        layout: with its size in pixels. Pixels that belong to no tile are black.
        rig: at the resolution of a tile, see QuiltLayout.fitted.
        panel: its cone is the fan's angle if the rig has none; None: layout.panel, with 40 degrees.
        background: see `encode`, also for antialiased, view_filter and device; a view is a view of the quilt.

    Raises:
        InputError: for arguments of other types or values.
    """
    expect("gaussians", gaussians, Gaussians)
    expect("layout", layout, QuiltLayout)
    expect("rig", rig, Rig)
    if panel is not None:
        expect("panel", panel, Panel)
    width, height = layout.tile_px()
    fan = _fan(layout, panel, width, height)
    out = torch.zeros(layout.height_px or 0, layout.width_px or 0, 3, dtype=torch.uint8, device=gaussians.device)
    # x counts views from the right-most camera, quilts count from the left-most
    places = np.arange(layout.views)[::-1] + 0.5
    each = max(1, _PIXELS // (width * height))
    for first in range(0, layout.views, each):
        pictures = render_views(
            gaussians,
            fan,
            rig,
            places[first : first + each],
            background=background,
            antialiased=antialiased,
            view_filter=view_filter,
            device=device,
        )
        for view, picture in enumerate(to_bytes(pictures), first):
            out[layout.tile(view)] = picture
    return out


def _fan(layout: QuiltLayout, panel: Panel | None, width: int, height: int) -> Panel:
    """Return the panel that cameras are asked of: with a view for each tile, and the size of one."""
    fan = layout.panel(40.0) if panel is None else panel
    values = {**fan.to_dict(), "width_px": width, "height_px": height, "views": layout.views, "invert_views": False}
    return Panel(**values)


@torch.no_grad()
def rgbd(
    gaussians: Gaussians, panel: Panel, rig: Rig, *, background: Colour = (1.0, 1.0, 1.0), antialiased: bool = False
) -> tuple[Tensor, tuple[float, float]]:
    """Draw the picture of the rig's centre camera with its depths beside it, and the depths at the ends of their scale.

    Returns:
        uint8 [H, 2 W, 3], H and W the panel's; and (near, far), view-space z in scene units. The right half is the
        disparity, 1 / z, grey: 255 at near, 0 at far and where nothing is (Looking Glass's RGB-D). Reading it with
        --depth-range near,far gives the depths back.

    Raises:
        InputError: where the camera sees nothing.
    """
    cameras = rig.cameras_at(panel, [panel.views / 2])
    images = render(gaussians, cameras, background=background, alpha=True, depth=True, antialiased=antialiased)
    alpha, depth = cast(Tensor, images.alpha)[0], cast(Tensor, images.depth)[0]
    covered = (alpha >= _COVERED) & (depth > 0)
    if not bool(covered.any()):
        raise InputError("RGB-D: the centre camera sees nothing; look at the pose of the rig")
    near, far = float(depth[covered].min()), float(depth[covered].max())
    # A flat scene is all near
    far = max(far, near * (1 + 1e-6))
    grey = torch.where(covered, (1 / depth - 1 / far) / (1 / near - 1 / far), torch.zeros_like(depth))
    halves = torch.cat([images.image[0], grey[..., None].expand(-1, -1, 3)], 1)
    return to_bytes(halves), (near, far)
