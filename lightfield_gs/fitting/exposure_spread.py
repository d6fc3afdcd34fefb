"""How much photographs differ in exposure, by the points of structure from motion that several of them show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeGuard

import numpy as np

from lightfield_gs.io.captures.capture import Capture

# From this spread on a fit has exposures of its own. Of plush, solids-arc-1 and solids-round-1, by which it was chosen,
# the spreads are 0.076, 0.037 and 0.028, and 0.004 at most of the latter two without their exposures. Those of banana,
# solids-arc-2 and solids-round-2, which had no part in it, are 0.026, 0.030 and 0.031.
LEAST_SPREAD = 0.01
_MOST_PHOTOGRAPHS, _MOST_POINTS, _LONGEST_PX = 32, 5000, 320  # that are looked at, spread evenly
_DARKEST, _BRIGHTEST = 0.05, 0.95  # beyond, noise and clipping hide the exposure
_OTHER_HUE = 0.04  # a larger difference of red, green and blue as fractions of their sum is of a thing before the point
_FEWEST_PHOTOGRAPHS, _FEWEST_POINTS = 3, 50  # that show a point, and that a photograph shows
_ROUNDS = 10


def exposure_spread(capture: Capture, indices: Sequence[int]) -> float | None:
    """Return how much the exposures of photographs differ.

    The logarithm of a pixel is the sum of its point's own and of its photograph's, but for highlights and for points
    that something hides. Both are found by medians in turn (Tukey's median polish), which such pixels do not move.

    Args:
        capture: the photographs, and points of structure from motion.
        indices: of the photographs that count.

    Returns:
        The standard deviation of the logarithms of photographs' brightness; None where too few points are in too few
        photographs, or where cameras are neither pinholes nor fisheyes.
    """
    if capture.model not in ("pinhole", "fisheye"):
        return None
    some = [indices[int(place)] for place in np.linspace(0, len(indices) - 1, min(len(indices), _MOST_PHOTOGRAPHS))]
    every = -(-max(1, len(capture.points)) // _MOST_POINTS)
    points, colours = capture.points[::every], capture.colours[::every]
    small = capture.reduced(_LONGEST_PX) if capture.sizes_px.max() > _LONGEST_PX else capture
    logs = np.stack([_log_brightness(small, index, points, colours) for index in some])
    logs = logs[np.isfinite(logs).sum(1) >= _FEWEST_POINTS]
    logs = logs[:, np.isfinite(logs).sum(0) >= _FEWEST_PHOTOGRAPHS]
    logs = logs[np.isfinite(logs).sum(1) >= _FEWEST_POINTS]
    logs = logs[:, np.isfinite(logs).any(0)]
    if len(logs) < _FEWEST_PHOTOGRAPHS:
        return None
    exposures = np.zeros(len(logs))
    for _ in range(_ROUNDS):
        own = np.nanmedian(logs - exposures[:, None], 0)
        exposures = np.nanmedian(logs - own, 1)
        exposures -= exposures.mean()
    return float(exposures.std())


def asks_for_exposures(spread: float | None) -> TypeGuard[float]:
    """Return whether photographs of this spread, see exposure_spread, are fitted with exposures by default."""
    return spread is not None and spread >= LEAST_SPREAD


def _log_brightness(capture: Capture, index: int, points: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Return [P], the logarithm of the brightness of the pixel at each point; NaN where the photograph has none.

    Args:
        capture: the photographs.
        index: of the photograph.
        points: [P,3].
        colours: [P,3], theirs; at another hue something stands before the point.
    """
    pose, (width, height) = capture.world_to_camera[index], capture.sizes_px[index]
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    fx, fy, cx, cy = capture.intrinsics[index]
    slope = np.hypot(x, y) / np.where(z > 0, z, 1)
    # A fisheye's distance from the middle is the angle, see Cameras
    scale = 1 if capture.model == "pinhole" else np.arctan(slope) / np.maximum(slope, 1e-12)
    column, row = (f * scale * a / np.where(z > 0, z, 1) + c for f, a, c in ((fx, x, cx), (fy, y, cy)))
    is_inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    place = row[is_inside].astype(np.int64), column[is_inside].astype(np.int64)
    pixels = capture.image(index)[place]
    brightness = pixels.mean(-1) / 255
    is_fair = (brightness > _DARKEST) & (brightness < _BRIGHTEST)
    is_fair &= (np.abs(_hue(pixels) - _hue(colours[is_inside])) < _OTHER_HUE).all(-1)
    if (mask := capture.mask(index)) is not None:
        is_fair &= mask[place] == 255
    logs = np.full(len(points), np.nan)
    logs[is_inside] = np.log(np.where(is_fair, brightness, np.nan))
    return logs


def _hue(colours: np.ndarray) -> np.ndarray:
    """Return red, green and blue [P,3] as fractions of their sum."""
    return colours / np.maximum(colours.sum(-1, keepdims=True), 1).astype(np.float64)
