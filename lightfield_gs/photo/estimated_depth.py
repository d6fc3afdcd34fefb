"""What a network's numbers mean: disparities up to an unknown scale and offset, or distances, as view-space z."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from lightfield_gs.photo.depth import FARTHEST

DEPTH_LIMITS = (1.0, 1.6)  # near and far where the network does not know them: deep enough, with little that is hidden
_PERCENTILES = (0.01, 0.99)  # of the disparities that are put at far and at near
_NEARER = 0.25  # by how much of the range the nearest go on beyond near
_FLAT = 1e-4  # range of the disparities, as a share of the largest, below which there is no depth in them


@dataclass
class Estimate:
    """The numbers of a network as disparities, and the way from there to z.

    disparities: [h, w]. spread: their range, > 0. z: of disparities of any shape, float32. said and notes: as in
    DepthMap.
    """

    disparities: Tensor
    spread: float
    z: Callable[[Tensor], Tensor]
    description: str
    notes: list[str] = field(default_factory=list)


def z_of_disparities(values: Tensor, limits: tuple[float, float] | None = None) -> Estimate:
    """Of disparities [h, w] of unknown scale and offset; limits: near and far, None: DEPTH_LIMITS."""
    near, far = limits or DEPTH_LIMITS
    low, high = _percentiles(values)
    spread = high - low
    notes = []
    if not spread > _FLAT * max(abs(low), abs(high)):
        spread = 1.0
        notes.append("there is no depth in what it sees, and the scene is flat")
        values = torch.full_like(values, low)
    description = f"disparities, of which the 1st and the 99th percentile are put at z {far:g} and {near:g}"

    def z(disparities: Tensor) -> Tensor:
        share = ((disparities.float() - low) / spread).clamp(0, 1 + _NEARER)
        return 1 / (1 / far + (1 / near - 1 / far) * share)

    return Estimate(values, spread, z, description + (" (assumed; --depth-range)" if limits is None else ""), notes)


def z_of_distances(values: Tensor) -> Estimate:
    """Of distances [h, w]; what is no distance > 0 gets no depth."""
    measured = (values > 1 / FARTHEST) & (values < FARTHEST)
    # The place of a pixel without a distance counts as infinitely far, until it is left out
    disparities = torch.where(measured, 1 / values, 0)
    low, high = _percentiles(disparities)
    notes = [] if bool(measured.all()) else [f"{1 - float(measured.double().mean()):.1%} have no distance"]
    z = lambda values: torch.where(values > 1 / FARTHEST, 1 / values.float(), torch.nan)
    description = "distances"
    if bool(measured.any()):
        description += f" {float(values[measured].min()):.4g}..{float(values[measured].max()):.4g}"
    return Estimate(disparities, max(high - low, _FLAT * high, 1 / FARTHEST), z, description, notes)


def _percentiles(values: Tensor) -> tuple[float, float]:
    """Those of _PERCENTILES, each a value that occurs."""
    ordered = values.ravel().sort().values
    low, high = (float(ordered[round(share * (len(ordered) - 1))]) for share in _PERCENTILES)
    return low, high
