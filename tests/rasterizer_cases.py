"""Small random scenes, cameras and panels for the tests of the rasterizer."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from panel_cases import TEMPLATE_LENS

from lightfield_gs import reference
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.reference import frustum_limits
from lightfield_gs.reference.blend import ALPHA_MIN, Projection, Samples, Scene
from lightfield_gs.scene.gaussians import Gaussians


def random_scene(
    count: int,
    degree: int = 0,
    seed: int = 0,
    *,
    depth: float = 2.0,
    extent: float = 0.6,
    size: float = 0.08,
    dtype: torch.dtype = torch.float64,
) -> Gaussians:
    """`count` Gaussians in a box of half width `extent` at `depth`, flat to round, of any rotation."""
    random = np.random.default_rng(seed)
    means = random.uniform(-extent, extent, (count, 3)) + [0, 0, depth]
    scales = np.exp(random.normal(math.log(size), 0.6, (count, 3)))
    sh = 0.15 * random.normal(size=(count, (degree + 1) ** 2, 3))
    sh[:, 0] = random.uniform(-1.5, 1.5, (count, 3))
    fields = (means, random.normal(size=(count, 4)), scales, random.uniform(0.1, 0.95, count), sh)
    return Gaussians(*(torch.from_numpy(field).to(dtype) for field in fields))


def stacked(scenes: list[Gaussians]) -> Gaussians:
    """A batch of scenes of one size."""
    return Gaussians(*(torch.stack(fields) for fields in zip(*(scene.fields().values() for scene in scenes))))


def turned_pose(yaw: float, pitch: float, centre: tuple[float, float, float] = (0, 0, 2)) -> np.ndarray:
    """World-to-camera matrix of a camera that keeps `centre` 2 before it, turned by angles in radians."""
    a, b = pitch, yaw
    rotation = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]]) @ np.array(
        [[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]]
    )
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, np.array([0, 0, 2]) - rotation @ centre
    return matrix


def dense_views(batch: int, views: int, width: int, height: int) -> tuple[torch.Tensor, ...]:
    """world_to_camera [B,V,4,4], intrinsics [B,V,4], limits [B,V,5] of turned cameras, principal points off-centre."""
    poses, intrinsics, limits = [], [], []
    for index in range(batch * views):
        poses.append(turned_pose(0.25 * math.sin(index + 1), 0.2 * math.cos(2 * index)))
        camera = (1.1 * width, 1.3 * width, (0.42 + 0.03 * index) * width, (0.55 - 0.02 * index) * height)
        intrinsics.append(camera)
        limits.append([*frustum_limits(*camera, width, height).tolist(), 0.0])
    shape = (batch, views)
    return tuple(
        torch.tensor(np.array(rows)).reshape(*shape, *np.shape(rows)[1:]) for rows in (poses, intrinsics, limits)
    )


BASE_PANEL = dict(TEMPLATE_LENS, width_px=110, height_px=46, views=96, phase=-2161.204484657574, cone_deg=40.0)
# As a 16-inch Looking Glass of the third generation has them
CELLS = (((-0.31, 0.25), (0.28, 0.25), (0.0, -0.25)), ((-0.31, -0.25), (0.28, -0.25), (0.0, 0.25)))
MIRRORED = (((-1 / 3, 0.0), (0.0, 0.0), (1 / 3, 0.0)), ((1 / 3, 0.1), (0.0, 0.0), (-1 / 3, 0.0)))
PANELS = {
    "default lens": {},
    "narrow cone": dict(cone_deg=5.0),
    "very wide cone": dict(cone_deg=90.0),
    "one view": dict(views=1),
    "two views": dict(views=2, line_number=2.0, slant_tan=0.0, phase=0.3),
    "leaning the other way, BGR": dict(slant_tan=-0.18, subpixel_order="BGR", phase=-7.25, line_number=16.013),
    "inverted": dict(invert_views=True),
    "upright lenses": dict(slant_tan=0.0, line_number=7.0, views=7, phase=0.5),
    "leaning strongly": dict(slant_tan=1.2),
    "leaning strongly the other way, odd size": dict(slant_tan=-2.5, width_px=97, height_px=61),
    "narrower than a pixel": dict(line_number=2.6, views=9, width_px=131),
    "narrower than a sub-pixel": dict(line_number=0.7, views=5),
    "three sub-pixels": dict(line_number=3.0003, views=4),
    "wide lenses": dict(line_number=45.3, views=45, slant_tan=-0.1),
    "just too wide for a mask": dict(line_number=63.4, views=70),
    "lenses as wide as the panel": dict(line_number=300.7, views=200, phase=1e6 + 0.1),
    "one lens for all": dict(line_number=5000.0, views=31),
    "one pixel": dict(width_px=1, height_px=1),
    "one row": dict(height_px=1, width_px=311),
    "one column": dict(height_px=129, width_px=1),
    "cells": dict(line_number=19.17, slant_tan=0.1455, subpixel_cells=CELLS, cell_pattern=2),
    "cells of four rows": dict(subpixel_cells=CELLS + MIRRORED, cell_pattern=3, cell_rows="top", height_px=43),
    "cells that exchange colours": dict(subpixel_cells=MIRRORED, cell_pattern=1, slant_tan=-0.18),
    "cells far aside": dict(subpixel_cells=(((-2.0, 0.3), (1.2, 0.25), (0.0, -3.0)), *CELLS), cell_pattern=4),
    "cells of narrow lenses": dict(subpixel_cells=CELLS, cell_pattern=4, cell_rule="webxr", line_number=4.6),
}


def panel(name: str = "default lens", **changes) -> Panel:
    return Panel(**{**BASE_PANEL, **PANELS[name], **changes})


def rig(panel: Panel, yaw: float = 0.0, pitch: float = 0.0, principal: tuple[float, float] = (0.5, 0.5)) -> Rig:
    """A rig 2 before the scene; the scene fills a good part of the height (at least 40 px are assumed)."""
    focal = 1.4 * max(40, panel.height_px)
    centre = (principal[0] * panel.width_px, principal[1] * panel.height_px)
    return Rig(turned_pose(yaw, pitch), (focal, 1.1 * focal), centre, 2.0)


def all_subpixels(panel: Panel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """rows, columns and channels of every sub-pixel, in the order of image.ravel()."""
    return tuple(index.ravel() for index in np.indices((panel.height_px, panel.width_px, 3)))


def projected(draw: Callable[..., Sequence[torch.Tensor]], count: int = 8) -> Callable[..., torch.Tensor]:
    """`draw`, of whose outputs `count` random sums are left: gradcheck takes a backward step for each of them, not for
    each sample."""

    def sums(*inputs: torch.Tensor) -> torch.Tensor:
        random = torch.Generator().manual_seed(3)
        total = torch.zeros(count, dtype=torch.float64)
        for out in draw(*inputs):
            weights = torch.randn(count, out.numel(), dtype=torch.float64, generator=random)
            total = total + weights @ out.flatten()
        return total

    return sums


def hard_scene(kind: str, count: int, seed: int) -> Gaussians:
    """A random scene of degree 1 made hard: of the kinds that the branches name."""
    scene = random_scene(count, 1, seed=seed)
    if kind == "clamped":
        scene.means[:, :2] *= 6
        scene.scales *= 3
    elif kind == "needles":
        scene.scales *= torch.tensor([0.02, 6.0, 0.02])
    elif kind == "huge":
        scene.scales *= 40
    elif kind == "opaque":
        scene.opacities[:] = 1
        scene.scales *= 3
    elif kind == "specks":
        scene.scales *= 1e-4
        scene.opacities[:] = 1
    elif kind == "near and far":
        scene.means[:, 2] = torch.linspace(-1, 60, count)
    elif kind == "equal depths":
        scene.means[:, 2] = 2 + 0.5 * (torch.arange(count) % 3)
    else:
        raise ValueError(f"no kind of hard scene {kind!r}")
    return scene


def _alphas(scene: Gaussians, panel: Panel, fan: Rig) -> tuple[torch.Tensor, torch.Tensor, int]:
    """Alphas of 1/255 and more, the sub-pixels that they are of, and how many of these there are."""
    rows, columns, channels = all_subpixels(panel)
    offsets = reference.lens_offsets(panel, fan, reference.lens_views(panel, rows, columns, channels))
    samples = Samples(*(torch.as_tensor(a, dtype=torch.float64) for a in (columns + 0.5, rows + 0.5, offsets)))
    projection = Projection(Scene.from_gaussians(scene), reference.rig_eye(panel, fan))
    sample, gaussian = projection.intersections(samples)
    alpha = projection.alpha(
        gaussian, samples=Samples(samples.columns[sample], samples.rows[sample], samples.offsets[sample])
    )
    reaches = alpha >= ALPHA_MIN * (1 - 1e-6)
    return alpha[reaches], sample[reaches], len(rows)


def reached(scene: Gaussians, panel: Panel, fan: Rig) -> np.ndarray:
    """How many Gaussians of every sub-pixel have an alpha of 1/255 or more."""
    _, sample, count = _alphas(scene, panel, fan)
    return torch.bincount(sample, minlength=count).numpy()


def alphas(scene: Gaussians, panel: Panel, fan: Rig) -> np.ndarray:
    """Of every sub-pixel, the sum of the alphas of all Gaussians of 1/255 and more."""
    alpha, sample, count = _alphas(scene, panel, fan)
    return torch.bincount(sample, alpha, minlength=count).numpy()
