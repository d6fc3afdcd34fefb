"""Scenes, panels, rigs, cameras and photos that the cases share; the same bits in every process."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from lightfield_gs import Cameras, Gaussians, Panel, Rig

CELLS = (((-0.31, 0.25), (0.28, 0.25), (0.0, -0.25)), ((-0.31, -0.25), (0.28, -0.25), (0.0, 0.25)))
MIRRORED = (((-1 / 3, 0.0), (0.0, 0.0), (1 / 3, 0.0)), ((1 / 3, 0.1), (0.0, 0.0), (-1 / 3, 0.0)))
PANELS: dict[str, dict[str, Any]] = {
    "stripes": {},
    "BGR": dict(subpixel_order="BGR", slant_tan=-0.18, phase=-7.25, line_number=16.013),
    "inverted": dict(invert_views=True),
    "wide lenses": dict(line_number=45.3, views=45, slant_tan=-0.1),
    "narrow lenses": dict(line_number=2.6, views=9, cone_deg=5.0),
    "cells": dict(line_number=19.17, slant_tan=0.1455, subpixel_cells=CELLS, cell_pattern=2),
    "cells out of order": dict(subpixel_cells=MIRRORED, cell_pattern=1, slant_tan=-0.18, cell_rows="top"),
}


def panel(name: str = "stripes", **changes: Any) -> Panel:
    size = dict(width_px=150, height_px=84, views=24, line_number=9.848282191911, slant_tan=1 / 6, phase=-2161.2)
    distance = dict(viewing_distance_mm=600, pixel_pitch_mm=0.3, name=name)
    return Panel(**{**size, **distance, **PANELS[name], **changes})


def scene(
    count: int = 300,
    degree: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
    size: float = 0.06,
    batch: int | None = None,
) -> Gaussians:
    """Gaussians in a box about (0, 0, 2)."""
    random = np.random.default_rng(seed)
    lead = (count,) if batch is None else (batch, count)
    sh = 0.2 * random.normal(size=(*lead, (degree + 1) ** 2, 3))
    sh[..., 0, :] = random.uniform(-1.5, 1.5, (*lead, 3))
    fields = (
        random.uniform(-0.6, 0.6, (*lead, 3)) + [0, 0, 2],
        random.normal(size=(*lead, 4)),
        np.exp(random.normal(math.log(size), 0.6, (*lead, 3))),
        random.uniform(0.05, 0.95, lead),
        sh,
    )
    return Gaussians(*(torch.from_numpy(field).to(device, dtype) for field in fields))


def pose(yaw: float = 0.1, pitch: float = -0.05) -> np.ndarray:
    """A camera that keeps (0, 0, 2) at a distance of 2, turned by angles in radians."""
    a, b = pitch, yaw
    down = np.array([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    across = np.array([[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]])
    matrix = np.eye(4)
    matrix[:3, :3] = down @ across
    matrix[:3, 3] = np.array([0, 0, 2]) - matrix[:3, :3] @ [0, 0, 2]
    return matrix


def rig(of: Panel, yaw: float = 0.1, **changes: Any) -> Rig:
    size = of.height_px
    values = dict(
        world_to_camera=pose(yaw),
        focal_px=(1.4 * size, 1.5 * size),
        principal_point_px=(0.48 * of.width_px, 0.53 * size),
        zero_depth=2.0,
    )
    return Rig(**{**values, **changes})


def arc(count: int, width: int, height: int, device: torch.device | str = "cpu", dtype=torch.float64) -> Cameras:
    """Cameras on an arc that look at the scene, no two with the same focal length."""
    angles = np.linspace(-0.4, 0.4, count)
    grow = 1 + 0.1 * np.sin(np.arange(count))
    poses = np.stack([pose(angle, 0.1 * math.sin(3 * angle)) for angle in angles])
    focals = np.stack([1.4 * height * grow, 1.5 * height * grow], 1)
    centres = np.stack([width / 2 + 3 * np.cos(np.arange(count)), np.full(count, 0.47 * height)], 1)
    return Cameras(*(torch.from_numpy(a).to(device, dtype) for a in (poses, focals, centres)), width, height)


def view_map(of: Panel, views: int) -> np.ndarray:
    """Any view at any sub-pixel; a tenth show nothing."""
    random = np.random.default_rng(5)
    table = random.integers(0, views, (of.height_px, of.width_px, 3), np.int32)
    table[random.random(table.shape) < 0.1] = -1
    return table


def photo(height: int = 120, width: int = 150) -> np.ndarray:
    """RGBA uint8: a shaded ball with a stick."""
    rows, columns = np.mgrid[:height, :width]
    x, y = (columns - 0.55 * width) / (0.3 * height), (rows - 0.5 * height) / (0.3 * height)
    inside = (x**2 + y**2 < 1) | (abs(x) < 0.1) & (y < 0) & (y > -1.4)
    shade = 0.4 + 0.5 * np.clip(1 - x**2 - y**2, 0, 1)
    colours = np.stack([shade, 0.7 * shade + 0.2 * (np.sin(8 * x) > 0), 0.3 + 0.2 * np.cos(5 * y), inside], -1)
    return np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8)


def depth(height: int = 120, width: int = 150) -> np.ndarray:
    """Distances of a slanted wall and a ball before it, with a hole, float32."""
    rows, columns = np.mgrid[:height, :width]
    x, y = (columns - 0.55 * width) / (0.3 * height), (rows - 0.5 * height) / (0.3 * height)
    z = np.where(x**2 + y**2 < 1, 1.5 - 0.3 * np.sqrt(np.clip(1 - x**2 - y**2, 0, 1)), 2.2 + 0.1 * x)
    z[:9, :14] = np.nan
    return z.astype(np.float32)
