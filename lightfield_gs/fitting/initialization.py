"""The initial Gaussians of a fit: one at each point of structure from motion, or random Gaussians."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.fitting.random import Purpose, uniforms
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.scene.gaussians import Gaussians

_FEWEST_POINTS = 100  # fewer say too little about the scene
_NEIGHBOURS = 3
_OPACITY = {"mcmc": 0.5, "adaptive": 0.1}


def initialize_gaussians(
    points: np.ndarray, colours: np.ndarray, centres: np.ndarray, settings: FitSettings
) -> Gaussians:
    """Return float32 Gaussians of SH degree 0, settings.cap_max at most.

    Scales are the root mean square distance to three neighbours (Kerbl et al. 2023), times settings.init_scale. Fewer
    than 100 points are replaced by random ones within three extents of the cameras, with random colours.

    Args:
        points: [P,3], normalised coordinates.
        colours: [P,3] uint8.
        centres: [C,3], of the cameras.
        settings: of the fit.
    """
    if len(points) < _FEWEST_POINTS:
        assume(
            f"{len(points)} points are too few to begin with: expected {_FEWEST_POINTS} or more, so the fit begins "
            "with random Gaussians around the cameras, and takes longer"
        )
        points, colours = _random_points(centres, settings)
    if len(points) > settings.cap_max:
        kept = _choose(len(points), settings.cap_max, settings.seed)
        assume(f"{len(kept)} of {len(points)} points are used: no more Gaussians were asked for")
        points, colours = points[kept], colours[kept]
    opacity = _OPACITY[settings.density] if settings.init_opa is None else settings.init_opa
    means = torch.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
    scales = (neighbour_distances(points) * settings.init_scale).float()[:, None].repeat(1, 3)
    quaternions = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1)
    sh = (torch.from_numpy(np.asarray(colours, np.float32) / 255)[:, None] - 0.5) / SH_CONSTANT
    return Gaussians(means, quaternions, scales, torch.full((len(means),), opacity), sh.contiguous())


def neighbour_distances(points: np.ndarray) -> Tensor:
    """Return [P] float64, the root mean square distance of each point [P,3] to its three nearest others; positive."""
    from scipy.spatial import cKDTree

    found, _ = cKDTree(points).query(points, k=min(_NEIGHBOURS + 1, len(points)), workers=-1)
    squares = (found[:, 1:] ** 2).mean(1) if len(points) > 1 else np.ones(1)
    return torch.from_numpy(np.sqrt(np.maximum(squares, 1e-7**2)))


def _random_points(centres: np.ndarray, settings: FitSettings) -> tuple[np.ndarray, np.ndarray]:
    """Return points in a cube of three extents round the cameras, and their colours."""
    count = min(settings.cap_max, 100_000)
    numbers = uniforms(settings.seed, 0, Purpose.INITIAL, 6 * count).numpy().reshape(count, 6)
    middle = np.median(centres, 0)
    return middle + 6 * (numbers[:, :3] - 0.5), (255 * numbers[:, 3:]).astype(np.uint8)


def _choose(count: int, wanted: int, seed: int) -> np.ndarray:
    """Return `wanted` of the numbers below `count`, chosen by the seed, ascending."""
    return np.sort(np.argsort(uniforms(seed, 1, Purpose.INITIAL, count).numpy(), kind="stable")[:wanted])
