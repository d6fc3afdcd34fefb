"""The coordinates that a fit works in: the cameras about the origin, and their extent 1.

Captures come in any unit and at any place, some in metres from a state's survey mark. Rates and limits are those of
an extent of 1, and float32 has the most digits about the origin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lightfield_gs.scene.gaussians import Gaussians


@dataclass(frozen=True)
class World:
    """centre: in the capture's coordinates, where those of the fit have their origin; extent: their unit."""

    centre: tuple[float, float, float]
    extent: float

    @classmethod
    def of(cls, centres: np.ndarray, extent: float) -> World:
        """Of cameras that stand at centres [C,3]: their median is the origin."""
        x, y, z = map(float, np.median(centres, 0))
        return cls((x, y, z), extent)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points [...,3] in coordinates of the fit."""
        return (points - np.array(self.centre)) / self.extent

    def poses(self, world_to_camera: np.ndarray) -> np.ndarray:
        """world_to_camera [C,4,4] for coordinates of the fit, with the unit of depth that they have."""
        poses = world_to_camera.copy()
        poses[:, :3, 3] = (poses[:, :3, :3] @ np.array(self.centre) + poses[:, :3, 3]) / self.extent
        return poses

    def back(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians in units of the capture, with its coordinates as their origin."""
        return replace(
            gaussians, means=gaussians.means * self.extent, scales=gaussians.scales * self.extent, origin=self.centre
        )
