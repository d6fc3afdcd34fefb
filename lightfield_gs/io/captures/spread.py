"""How far the cameras of a capture stand apart."""

from __future__ import annotations

import numpy as np

_MARGIN = 1.1  # Kerbl et al.
_OUTLIER = 3.0  # times the median distance: from there on a camera does not count


def extent_of(centres: np.ndarray, points: np.ndarray) -> float:
    """The extent of a scene, scene units, > 0, from where cameras stand [C,3] and points [P,3].

    As Kerbl et al., "3D Gaussian Splatting" (2023), have it: 1.1 times the largest distance of a camera from the mean
    of all; but of those cameras alone that stand within 3 times the median distance from the median place (of each
    coordinate), so that one pose that is wrong does not blow it up. For a ring of cameras it is 1.1 times the radius.
    Where all cameras stand at one place: the median distance of the points from it; without points, 1.
    """
    away = np.linalg.norm(centres - np.median(centres, 0), axis=1)
    kept = centres[away <= max(_OUTLIER * float(np.median(away)), 1e-12 * float(np.abs(centres).max()))]
    radius = _MARGIN * float(np.linalg.norm(kept - kept.mean(0), axis=1).max()) if len(kept) else 0.0
    if radius > 1e-9 * (1 + float(np.abs(centres).max())):
        return radius
    distance = float(np.median(np.linalg.norm(points - centres.mean(0), axis=1))) if len(points) else 0.0
    return distance if distance > 0 else 1.0
