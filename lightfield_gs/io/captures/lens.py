"""Lens distortion, by the polynomial model of OpenCV's and nerfstudio's cameras, and pictures freed of it.

Source: Brown, "Close-range camera calibration", 1971, in the form of OpenCV's calib3d: a point (x, y) at depth 1 is
seen at
    x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 y^2) + 2 p2 x y,   r^2 = x^2 + y^2,
both in units of the focal length. (OpenCV's own k4 is of another, rational model, FULL_OPENCV.)
"""

from __future__ import annotations

import numpy as np

from lightfield_gs.base.errors import InputError

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
_LARGEST_LOSS = 0.25  # share of a picture's area that a lens may cost: more is a mistake in its numbers


def distorted(points: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Where points [...,2] at depth 1 are seen, float64, by a lens of coefficients [6] in the order of COEFFICIENTS."""
    x, y = points[..., 0], points[..., 1]
    k1, k2, k3, k4, p1, p2 = coefficients
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def source_places(intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """Where in the stored picture each pixel of the undistorted one is, [H,W,2] float64: x and y in pixels from the
    outer corner of the first; NaN where the polynomial folds the plane, so that no lens shows what is there.

    Both pictures have the intrinsics (fx, fy, cx, cy) and the size width_px x height_px.
    """
    columns, rows = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    points = (np.stack([columns, rows], -1) - intrinsics[2:]) / intrinsics[:2]
    with np.errstate(over="ignore", invalid="ignore"):
        places = distorted(points, coefficients) * intrinsics[:2] + intrinsics[2:]
        k1, k2, k3, k4 = coefficients[:4]
        r2 = (points**2).sum(-1)
        growing = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * (7 * k3 + r2 * 9 * k4))) > 0  # d (r radial) / d r
    first_fold = r2[~growing].min(initial=np.inf)
    places[(r2 >= first_fold) | ~np.isfinite(places).all(-1)] = np.nan
    return places


def check_distortion(
    field: str, intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int
) -> None:
    """Raises InputError, beginning with `field`, for coefficients that leave much of the picture without a place."""
    lost = np.isnan(_coarse_places(intrinsics, coefficients, width_px, height_px)).any(-1).mean()
    if lost > _LARGEST_LOSS:
        raise InputError(
            f"{field}: bad intrinsics: the lens distortion {words(coefficients)} folds {lost:.0%} of the "
            "picture onto the rest: expected coefficients for lengths in units of the focal length; or "
            "undistort the images first and leave them out"
        )


def share_beyond(intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int) -> float:
    """The share 0..1 of the stored picture that lies beyond the frame of the undistorted one, to some 2 %."""
    places = _coarse_places(intrinsics, coefficients, width_px, height_px)
    height, width = np.maximum(np.array(places.shape[:2]) // 2, 1)
    cells = np.floor(places[~np.isnan(places).any(-1)] / 2).astype(int)  # of four pixels, so that few are leapt over
    cells = cells[((cells >= 0) & (cells < (width, height))).all(-1)]
    return 1 - len(np.unique(cells @ (1, width))) / (width * height)


def _coarse_places(intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """source_places of a picture of some 128 pixels a side: enough to measure areas."""
    scale = 128 / max(width_px, height_px)
    width, height = (max(2, round(side * scale)) for side in (width_px, height_px))
    return source_places(intrinsics * scale, coefficients, width, height)


def undistorted(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """A picture uint8 [H,W,C] looked up at places [H,W,2] of source_places, bilinearly; 0 beyond its edges."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((1, 2), (1, 2), (0, 0))).astype(np.float32)
    inside = np.nan_to_num(np.clip(places, -0.5, (width + 0.5, height + 0.5)), nan=-0.5) + 0.5  # pixel centres, padded
    first = np.floor(inside).astype(np.int64)
    x, y = np.moveaxis(first, -1, 0)
    right, down = np.moveaxis((inside - first).astype(np.float32)[..., None], -2, 0)
    upper = padded[y, x] * (1 - right) + padded[y, x + 1] * right
    lower = padded[y + 1, x] * (1 - right) + padded[y + 1, x + 1] * right
    return np.rint(upper * (1 - down) + lower * down).astype(np.uint8)


def words(coefficients: np.ndarray) -> str:
    """The coefficients that are not zero, for people."""
    return ", ".join(f"{name} {value:g}" for name, value in zip(COEFFICIENTS, coefficients) if value)
