"""The depth of the surface that a picture shows at one of its points."""

from __future__ import annotations

import torch

from lightfield_gs.base.checks import is_row, real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.extent import part
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.visibility import check_single, plain
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

_PATCH = 0.01  # side of the square around the point that is looked at, in shorter sides of the panel
_LEAST_PATCH_PX = 2.0  # of the panel: a smaller square would see less than a pixel does
_SAMPLES = 16  # of the square, each way
_OPAQUE = 0.5  # alpha from which on a sample shows a surface
_SURFACE_SHARE = 0.25  # share of the square that a surface fills at least: thin things count before what is behind


def depth_at(gaussians: Gaussians, panel: Panel, rig: Rig, point: tuple[float, float]) -> float:
    """View-space z, in scene units, of the nearest opaque surface that the centre camera sees at a point.

    point: (x, y) of its picture, 0..1 each, of the panel's width from the left and of its height from the top.
    The surface is the nearest depth by which a quarter of a small square around the point (1 % of the panel's shorter
    side) is opaque, alpha 0.5 or more, if only the Gaussians up to it are drawn: neither what is behind nor haze before
    it moves it, as they would a mean depth. Raises InputError, also where there is no such surface.
    """
    check_single(gaussians)
    if not is_row(point, 2):
        raise InputError(f"focus: expected x,y of a point of the picture, 0..1 each, got {shown(point)}")
    x, y = (real_number(f"focus: {axis}", value, 0, 1) for axis, value in zip("xy", point))
    with torch.no_grad():
        return _surface(plain(gaussians.detach()), _patch(panel, rig, x, y), f"{x:g},{y:g}")


def _surface(gaussians: Gaussians, camera: Cameras, name: str) -> float:
    """Depth of the nearest opaque surface before this camera; name: of the point, for the complaint."""
    _, alpha, radii = render(gaussians, camera, alpha=True, radii=True)
    if _opaque_share(alpha) < _SURFACE_SHARE:
        raise InputError(
            f"focus: nothing opaque is at {name} of the picture (alpha {float(alpha.mean()):.2g}, expected {_OPAQUE:g} "
            "or more); give another point (x,y: of the width from the left, of the height from the top), or a depth"
        )
    drawn = part(gaussians, radii[0] > 0)
    pose = camera.world_to_camera[0].to(drawn.means)
    depths, order = (drawn.means @ pose[2, :3] + pose[2, 3]).sort()
    few, enough = 0, len(order)  # so many of the nearest are too few, and enough, to make a surface
    while enough - few > 1:
        middle = (few + enough) // 2
        alpha = render(part(drawn, order[:middle]), camera, alpha=True)[1]
        few, enough = (few, middle) if _opaque_share(alpha) >= _SURFACE_SHARE else (middle, enough)
    return float(depths[enough - 1])


def _opaque_share(alpha: torch.Tensor) -> float:
    return float((alpha >= _OPAQUE).double().mean())


def _patch(panel: Panel, rig: Rig, x: float, y: float) -> Cameras:
    """The centre camera, of whose picture only a small square around the point is left."""
    centre = rig.cameras_at(panel, [panel.views / 2])
    side = max(_LEAST_PATCH_PX, _PATCH * min(panel.width_px, panel.height_px))
    scale = _SAMPLES / side
    corner = torch.tensor([x * panel.width_px - side / 2, y * panel.height_px - side / 2], dtype=torch.float64)
    principal_point = torch.tensor([rig.principal_point_px], dtype=torch.float64)
    return Cameras(
        centre.world_to_camera,
        centre.focal_px * scale,
        (principal_point - corner) * scale,
        _SAMPLES,
        _SAMPLES,
        jacobian_limits=centre.jacobian_limits,
    )
