"""Synthetic scenes for benchmarks: the same Gaussians, bit for bit, wherever they are made.

`sheet:S` is what a single-image network draws: S*S Gaussians, one per pixel, on a wavy sheet of depths round 2.
`cloud:N` is its opposite: N Gaussians of any rotation, log-normal in size, on three nested shells, overlapping deeply.
The centre camera stands at the origin and looks along +z; the zero plane is at depth 2, the focal length the panel's
width in pixels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightfield_gs.errors import InputError
from lightfield_gs.gaussians import Gaussians

ZERO_DEPTH = 2.0
_SH_CONSTANT = 0.28209479177387814  # the harmonic of degree 0


def sheet(side: int, seed: int = 0) -> Gaussians:
    """side*side Gaussians, row by row over an image twice as wide as high, SH degree 0."""
    random = np.random.default_rng(seed)
    count = side * side
    index = np.arange(count)
    across = (index % side + 0.5) / side - 0.5
    down = (index // side + 0.5) / side - 0.5

    # The draws follow each other in this order, and none may be left out: it is part of what the scene is.
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
    """`count` Gaussians on shells of radius 0.15, 0.3 and 0.45 round (0, 0, 2), coloured by direction, SH degree 0."""
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


def load_scene(name: str) -> Gaussians:
    """A scene by name: `sheet:S`, `cloud:N`, or the path of a .ply file. Raises InputError."""
    kind, _, size = name.partition(":")
    makers = {"sheet": sheet, "cloud": cloud}
    if kind in makers and size:
        if not size.isascii() or not size.isdigit() or not 1 <= int(size) <= 1 << 24:
            raise InputError(f"scene {name!r}: expected a whole number 1..16777216 after '{kind}:', got {size!r}")
        return makers[kind](int(size))
    if Path(name).suffix.lower() != ".ply":
        raise InputError(f"scene {name!r}: expected sheet:S, cloud:N or the path of a .ply file")
    return Gaussians.load(name)


def _gaussians(means: np.ndarray, quaternions: np.ndarray, scales: np.ndarray, opacities: np.ndarray,
               colours: np.ndarray) -> Gaussians:
    """Rounded to float32; colours [N,3] in 0..1 become the harmonics of degree 0 that give them back."""
    import torch

    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    stored = colours.astype(np.float32)
    harmonics = (stored.astype(np.float64)[:, None, :] - 0.5) / _SH_CONSTANT
    fields = (np.ascontiguousarray(field, np.float32) for field in (means, unit, scales, opacities, harmonics))
    return Gaussians(*(torch.from_numpy(field) for field in fields))
