"""Synthetic scenes and cones for benchmarks: the same Gaussians, bit for bit, wherever they are made.

`sheet:S` is like a single-image network's result: S*S Gaussians, one per pixel, on a wavy sheet of depths round 2.
`cloud:N` is the opposite: N Gaussians of random rotation and log-normal size on three nested shells, with much overlap.
The centre camera stands at the origin and looks along +z. The zero plane is at depth 2; the focal length is the panel's
width in pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.bench.names import ORACLE_SAMPLES
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.reference import subpixel_colours
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

ZERO_DEPTH = 2.0
NARROW_PX = 40.0  # disparity over all views of a point at 4/5 of the zero plane's depth, cone "narrow"
WIDE_DEG = 53.0  # cone "wide"
_HARMONIC_DEVIATIONS = (0.15, 0.1, 0.05)  # of the coefficients of degree 1, 2, 3
_HARMONIC_SEED = 99


def sheet(side: int, seed: int = 0) -> Gaussians:
    """Return side*side Gaussians, row by row over an image twice as wide as high, SH degree 0."""
    random = np.random.default_rng(seed)
    count = side * side
    index = np.arange(count)
    across = (index % side + 0.5) / side - 0.5
    down = (index // side + 0.5) / side - 0.5

    # The scene depends on the order of the random draws: none may be left out.
    depth = 2 + 0.28 * np.sin(9 * across) * np.cos(7 * down) + 0.1 * (random.random(count) - 0.5)
    means = np.stack([across * depth, 0.5 * down * depth, depth], axis=1)
    means[:, :2] += 0.002 * (random.random((count, 2)) - 0.5)
    spacing = depth / side
    width = spacing * (0.4 + 0.6 * random.random(count))
    height = 0.5 * spacing * (0.4 + 0.6 * random.random(count))
    thickness = spacing * (0.3 + random.random(count))
    quaternions = np.array([1.0, 0.0, 0.0, 0.0]) + 0.3 * (random.random((count, 4)) - 0.5)
    opacities = 0.3 + 0.69 * random.random(count)

    channel = np.arange(3)
    colours = 0.5 + 0.5 * np.sin(20 * across[:, None] + channel + 10 * down[:, None] * (channel + 1))
    return _gaussians(means, quaternions, np.stack([width, height, thickness], axis=1), opacities, colours)


def cloud(count: int, seed: int = 0) -> Gaussians:
    """Return `count` Gaussians on three shells round (0, 0, 2), coloured by direction, SH degree 0."""
    random = np.random.default_rng(seed)
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    shell = np.array([0.15, 0.3, 0.45])[random.integers(0, 3, count)]
    radius = shell + 0.01 * random.normal(size=count)
    means = direction * radius[:, None] + [0, 0, ZERO_DEPTH]
    scales = np.exp(random.normal(np.log(0.6 / np.sqrt(count)), 0.5, (count, 3)))
    quaternions = random.normal(size=(count, 4))
    opacities = random.uniform(0.05, 0.99, count)
    colours = np.clip(0.5 + 0.5 * direction + 0.1 * random.normal(size=(count, 3)), 0, 1)
    return _gaussians(means, quaternions, scales, opacities, colours)


_MAKERS = {"sheet": sheet, "cloud": cloud}


def with_harmonics(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return a scene of SH degree 0 with random coefficients up to `degree` (1..3).

    The first coefficients are the same for each degree.
    """
    random = np.random.default_rng(_HARMONIC_SEED)
    bands = [
        random.normal(0, _HARMONIC_DEVIATIONS[band - 1], (gaussians.count, 2 * band + 1, 3))
        for band in range(1, degree + 1)
    ]
    higher = torch.from_numpy(np.concatenate(bands, axis=1).astype(np.float32))
    return replace(gaussians, sh=torch.cat([gaussians.sh, higher], dim=1))


def check_scene(name: str, sh_degree: int | None = None) -> None:
    """Raise InputError if `load_scene` has no such scene, without reading files."""
    kind, _, size = name.partition(":")
    if kind in _MAKERS and size:
        if not size.isascii() or not size.isdigit() or not 1 <= int(size) <= 1 << 24:
            raise InputError(f"scene {name!r}: expected a whole number 1..16777216 after '{kind}:', got {size!r}")
        return
    if Path(name).suffix.lower() != ".ply":
        raise InputError(f"scene {name!r}: expected sheet:S, cloud:N or the path of a .ply file")
    if sh_degree is not None:
        raise InputError(f"scene {name!r}: a file has its own SH degree, leave out sh_degree=")
    if not checked_path(name).is_file():
        raise InputError(f"scene {name!r}: found no such file")


def load_scene(name: str, sh_degree: int | None = None) -> Gaussians:
    """Return a scene by name: `sheet:S`, `cloud:N`, or the path of a .ply file.

    Args:
        sh_degree: 0..3 of a synthetic scene (None: 0); a file has its own.

    Raises:
        InputError: there is no such scene.
    """
    check_scene(name, sh_degree)
    kind, _, size = name.partition(":")
    if kind in _MAKERS and size:
        scene = _MAKERS[kind](int(size))
        return with_harmonics(scene, sh_degree) if sh_degree else scene
    return Gaussians.load(name)


def cone_degrees(cone: str | float | None, panel: Panel, focal_px: float) -> float:
    """Return the full angle of a cone in degrees: `cone` may be a number, a name, or None for the panel's.

    "wide" is 53 degrees. In the cone "narrow" the outermost views (x = 0 and N) see a point at 4/5 of the zero plane's
    depth 40 px apart. The offsets of the rig are +-Z0 tan(cone/2), so fx 2 Z0 tan(cone/2) (5/4 - 1)/Z0 = 40 px.
    """
    if cone == "narrow":
        return 2 * math.degrees(math.atan(2 * NARROW_PX / focal_px))
    if cone == "wide":
        return WIDE_DEG
    return panel.cone_deg if cone is None else cast(float, cone)  # _cones lets no other names through


def benchmark_rig(scene: str, gaussians: Gaussians, panel: Panel, cone: str | float | None) -> Rig:
    """Return the rig of a scene: the rig of synthetic scenes, or automatic framing of a .ply file. Its cone is set."""
    if Path(scene).suffix.lower() == ".ply":
        rig = Rig.frame(gaussians, panel)
        return replace(rig, cone_deg=cone_degrees(cone, panel, rig.focal_px[0]))
    focal, centre = (panel.width_px, panel.width_px), (panel.width_px / 2, panel.height_px / 2)
    return Rig(np.eye(4), focal, centre, ZERO_DEPTH, cone_degrees(cone, panel, panel.width_px))


def _gaussians(
    means: np.ndarray, quaternions: np.ndarray, scales: np.ndarray, opacities: np.ndarray, colours: np.ndarray
) -> Gaussians:
    """Return Gaussians rounded to float32, with colours [N,3] in 0..1 as harmonics of degree 0."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    stored = colours.astype(np.float32)
    harmonics = (stored.astype(np.float64)[:, None, :] - 0.5) / SH_CONSTANT
    fields = (np.ascontiguousarray(field, np.float32) for field in (means, unit, scales, opacities, harmonics))
    return from_tensors(torch.from_numpy(field) for field in fields)


ORACLE_SEED = 1
PSNR_CAP_DB = 120.0  # of images without any error


@dataclass(frozen=True)
class OracleSamples:
    """Random sub-pixels (rows, columns, channels [M]) and the 8-bit values [M] that they must have."""

    rows: np.ndarray
    columns: np.ndarray
    channels: np.ndarray
    values: np.ndarray

    def errors(self, image: torch.Tensor) -> dict[str, float]:
        """Return the errors of an 8-bit image: psnr_db, max_error_255 and share_over_1.

        max_error_255 is in 1/255; share_over_1 is the fraction that is off by more than 1/255.
        """
        shown = image[self.rows, self.columns, self.channels].cpu().numpy()
        error = np.abs(shown.astype(np.int64) - self.values)
        mean_square = np.mean((error / 255) ** 2)
        psnr_db = PSNR_CAP_DB if mean_square == 0 else min(PSNR_CAP_DB, -10 * np.log10(mean_square))
        return {"psnr_db": float(psnr_db), "max_error_255": int(error.max()), "share_over_1": float(np.mean(error > 1))}


def oracle_samples(gaussians: Gaussians, panel: Panel, rig: Rig, count: int = ORACLE_SAMPLES) -> OracleSamples:
    """Return random sub-pixels of a panel, before a white background, by lightfield_gs.reference."""
    random = np.random.default_rng(ORACLE_SEED)
    rows = random.integers(0, panel.height_px, count)
    columns = random.integers(0, panel.width_px, count)
    channels = random.integers(0, 3, count)
    colours = subpixel_colours(gaussians, panel, rig, rows, columns, channels)
    return OracleSamples(rows, columns, channels, np.rint(255 * np.clip(colours, 0, 1)).astype(np.int64))
