"""Undistort and reduce images."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import Distortion, describe_coefficients, distort_brown

LARGEST_FOLDED_FRACTION = 0.25  # of an image: more is a mistake in the coefficients
_BAND = 256  # rows at a time: in float64 a whole photograph would take 100 bytes a pixel
_LEAST_ALPHA = 1e-3  # of 255: less is a rounding error of float32
_RAYS, _STEPS = 32, 2048  # directions and radii at which a lens is checked for folds


def brown_source_positions(
    intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int
) -> np.ndarray:
    """Return the position in the distorted image of each pixel of the undistorted one, by Brown's polynomial.

    Args:
        intrinsics: (fx, fy, cx, cy) of both images.
        coefficients: [6], in the order of BROWN_COEFFICIENTS.
        width_px, height_px: size of both images.

    Returns:
        [H,W,2] float64, x and y in pixels from the outer corner of the first; NaN where the polynomial folds the
            plane.
    """
    columns, rows = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    points = (np.stack([columns, rows], -1) - intrinsics[2:]) / intrinsics[:2]
    with np.errstate(over="ignore", invalid="ignore"):
        positions = distort_brown(points, coefficients) * intrinsics[:2] + intrinsics[2:]
        k1, k2, k3, k4 = coefficients[:4]
        r2 = (points**2).sum(-1)
        growing = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * (7 * k3 + r2 * 9 * k4))) > 0  # d (r radial) / d r
    first_fold = r2[~growing].min(initial=np.inf)
    positions[(r2 >= first_fold) | ~np.isfinite(positions).all(-1)] = np.nan
    return positions


def check_distortion(
    field: str, intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int
) -> None:
    """Raise InputError for coefficients that leave much of the image without a source.

    Args:
        field: the file and field, at the start of the message.
        intrinsics: (fx, fy, cx, cy) in pixels.
        coefficients: [6], in the order of BROWN_COEFFICIENTS.
        width_px, height_px: size of the image.
    """
    lost = np.isnan(_coarse_source_positions(intrinsics, coefficients, width_px, height_px)).any(-1).mean()
    if lost > LARGEST_FOLDED_FRACTION:
        raise InputError(
            f"{field}: bad intrinsics: the lens distortion {describe_coefficients(coefficients)} folds {lost:.0%} of "
            "the picture onto the rest: expected coefficients for lengths in units of the focal length; or "
            "undistort the images first and leave them out"
        )


def fraction_beyond(intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int) -> float:
    """Return the fraction 0..1 of the distorted image beyond the frame of the undistorted one, to some 2 %.

    Args:
        intrinsics: (fx, fy, cx, cy) of both images.
        coefficients: [6], in the order of BROWN_COEFFICIENTS.
        width_px, height_px: size of both images.
    """
    positions = _coarse_source_positions(intrinsics, coefficients, width_px, height_px)
    height, width = np.maximum(np.array(positions.shape[:2]) // 2, 1)
    # Cells of four pixels, so that few are skipped
    cells = np.floor(positions[~np.isnan(positions).any(-1)] / 2).astype(int)
    cells = cells[((cells >= 0) & (cells < (width, height))).all(-1)]
    return 1 - len(np.unique(cells @ (1, width))) / (width * height)


def _coarse_source_positions(
    intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int
) -> np.ndarray:
    """Return brown_source_positions of an image of some 128 pixels a side: enough to measure areas."""
    scale = 128 / max(width_px, height_px)
    width, height = (max(2, round(side * scale)) for side in (width_px, height_px))
    return brown_source_positions(intrinsics * scale, coefficients, width, height)


def undistort(image: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Sample an image bilinearly at source positions.

    Args:
        image: uint8 [H,W,C]; 0 beyond its edges.
        positions: [H,W,2], x and y in pixels, NaN where there is no source.

    Returns:
        uint8 [H,W,C].
    """
    height, width = image.shape[:2]
    padded = np.pad(image, ((1, 2), (1, 2), (0, 0))).astype(np.float32)
    # Relative to pixel centres of the padded image
    inside = np.nan_to_num(np.clip(positions, -0.5, (width + 0.5, height + 0.5)), nan=-0.5) + 0.5
    first = np.floor(inside).astype(np.int64)
    x, y = np.moveaxis(first, -1, 0)
    right, down = np.moveaxis((inside - first).astype(np.float32)[..., None], -2, 0)
    upper = padded[y, x] * (1 - right) + padded[y, x + 1] * right
    lower = padded[y + 1, x] * (1 - right) + padded[y + 1, x + 1] * right
    return np.rint(upper * (1 - down) + lower * down).astype(np.uint8)


def source_positions(
    distortion: Distortion,
    intrinsics: np.ndarray,
    width_px: int,
    height_px: int,
    rows: range | None = None,
    fisheye: bool = False,
) -> np.ndarray:
    """Return the position in a photograph of each pixel of its image by a camera without distortion.

    Args:
        distortion: of the photograph's lens.
        intrinsics: [4], (fx, fy, cx, cy) of both images.
        width_px, height_px: size of both images.
        rows: the rows to return; None: all.
        fisheye: the camera without distortion is an equidistant fisheye, for a lens that is one; else a pinhole.

    Returns:
        [H,W,2] float64, x and y in pixels from the outer corner of the first; NaN where the lens folds the plane.
    """
    y, x = np.meshgrid(
        np.arange(height_px)[range(height_px) if rows is None else rows] + 0.5, np.arange(width_px) + 0.5
    )
    points = (np.stack([x.T, y.T], -1) - intrinsics[2:]) / intrinsics[:2]
    distort = distortion.distort_flat if fisheye else distortion.distort
    positions = distort(points) * intrinsics[:2] + intrinsics[2:]
    corners = (np.array([(0, 0), (0, height_px), (width_px, 0), (width_px, height_px)]) - intrinsics[2:]) / intrinsics[
        :2
    ]
    largest = float(np.linalg.norm(corners, axis=1).max())
    fold = fold_radius(distortion, min(largest, np.pi) if fisheye else largest, fisheye)
    fold = min(fold, np.pi) if fisheye else fold
    beyond = points[..., 0] ** 2 + points[..., 1] ** 2 >= fold**2  # numpy is slow at sums over two numbers
    positions[beyond | ~np.isfinite(positions[..., 0] + positions[..., 1])] = np.nan
    return positions


@lru_cache(maxsize=16)  # of the bands of one picture
def fold_radius(distortion: Distortion, largest: float, fisheye: bool = False) -> float:
    """Return the radius at depth 1 where the lens begins to fold: a point further out appears nearer to the middle.

    With fisheye it is an angle in radians. It is infinite where the lens does not fold up to `largest`, and exact to a
    thousandth of that.
    """
    angles = np.arange(_RAYS) * (2 * np.pi / _RAYS)
    outward = np.stack([np.cos(angles), np.sin(angles)], -1)[:, None]
    radii = np.linspace(0, largest, _STEPS)
    distort = distortion.distort_flat if fisheye else distortion.distort
    along = (distort(outward * radii[:, None]) * outward).sum(-1)
    with np.errstate(invalid="ignore"):
        grows = (np.diff(along, axis=1) > 0).all(0)
    return np.inf if grows.all() else float(radii[grows.argmin()])


def folded_fraction(
    distortion: Distortion, intrinsics: np.ndarray, width_px: int, height_px: int, fisheye: bool = False
) -> float:
    """Return the fraction 0..1 of the image without distortion that the lens does not show at all, to some 2 %.

    Args:
        distortion: of the lens.
        intrinsics: [4], (fx, fy, cx, cy) of both images.
        width_px, height_px: size of both images.
        fisheye: see source_positions.
    """
    scale = 128 / max(width_px, height_px)
    width, height = (max(2, round(side * scale)) for side in (width_px, height_px))
    ratio = np.array([width / width_px, height / height_px] * 2)
    positions = source_positions(distortion, intrinsics * ratio, width, height, fisheye=fisheye)
    return float(np.isnan(positions).any(-1).mean())


@lru_cache(maxsize=2)  # photographs of one camera follow each other
def undistortion(
    distortion: Distortion, intrinsics: tuple[float, ...], width_px: int, height_px: int, fisheye: bool = False
) -> Undistortion:
    """Return the undistortion of photographs of this size, cached.

    Args:
        distortion: of the lens.
        intrinsics: (fx, fy, cx, cy) of the photograph.
        width_px, height_px: size of the photograph.
        fisheye: see source_positions.
    """
    return Undistortion(distortion, np.array(intrinsics), width_px, height_px, fisheye)


class Undistortion:
    """Undistorts images of one camera.

    Attributes:
        valid_area: uint8 [H,W], 255 within the distorted photograph and 0 beyond; None where all is within.
        grid: [1,H,W,2] float32, positions in -1..1 for grid_sample.
    """

    def __init__(
        self, distortion: Distortion, intrinsics: np.ndarray, width_px: int, height_px: int, fisheye: bool = False
    ):
        import torch

        grid = np.empty((1, height_px, width_px, 2), np.float32)  # -1..1 across the photograph, as grid_sample wants
        valid_area = np.empty((height_px, width_px), np.uint8)
        for top in range(0, height_px, _BAND):
            rows = range(top, min(top + _BAND, height_px))
            positions = source_positions(distortion, intrinsics, width_px, height_px, rows, fisheye)
            is_valid = (positions >= 0) & (positions <= (width_px, height_px))  # false for NaN
            inside = is_valid[..., 0] & is_valid[..., 1]
            valid_area[rows] = np.where(inside, 255, 0)
            grid[0, rows] = np.nan_to_num(positions / (width_px, height_px) * 2 - 1)
        self.valid_area: np.ndarray | None = None if valid_area.all() else valid_area
        self.grid = torch.from_numpy(grid)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Undistort an image [H,W,C] or [H,W], uint8 or float32, bilinearly; its edge pixels extend beyond it."""
        import torch

        planes = torch.from_numpy(np.ascontiguousarray(image)).reshape(*image.shape[:2], -1)
        planes = planes.permute(2, 0, 1)[None].float()
        found = torch.nn.functional.grid_sample(planes, self.grid, "bilinear", "border", align_corners=False)
        if image.dtype == np.uint8:
            found = found.round_().clamp_(0, 255).to(torch.uint8)
        return found[0].permute(1, 2, 0).reshape(image.shape).numpy()


def reduced(image: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """Reduce an image by an area filter: each pixel is the mean over its own area.

    Args:
        image: [H,W,...], uint8 or float32.
        width_px, height_px: size of the result.

    Returns:
        An image of the same type.
    """
    found = image
    for axis, size in ((0, height_px), (1, width_px)):
        if found.shape[axis] != size:
            found = _reduce_along(found, axis, size)
    return found if found.dtype == image.dtype else np.rint(found).clip(0, 255).astype(np.uint8)


def resampled(image: np.ndarray, undistort: Undistortion | None, width_px: int, height_px: int) -> np.ndarray:
    """Undistort and reduce a photograph; return its colours.

    Colours are weighted by alpha (Porter & Duff, "Compositing digital images", 1984), so that colours of transparent
    pixels do not reach the edges. Transparent pixels are black.

    Args:
        image: uint8 [H,W,3 or 4].
        undistort: of its camera; None for a pinhole.
        width_px, height_px: size of the result.

    Returns:
        uint8 [height_px,width_px,3].
    """
    size = (width_px, height_px)
    if undistort is None and image.shape[1::-1] == size:
        return image[..., :3]
    if image.shape[2] == 3 or image[..., 3].min() == 255:
        colours = image[..., :3]
        return reduced(colours if undistort is None else undistort(colours), *size)
    weighted = image.astype(np.float32)
    weighted[..., :3] *= weighted[..., 3:] / 255
    weighted = reduced(weighted if undistort is None else undistort(weighted), *size)
    colours = weighted[..., :3] * 255 / np.maximum(weighted[..., 3:], _LEAST_ALPHA)
    return np.rint(colours).clip(0, 255).astype(np.uint8)


def _reduce_along(image: np.ndarray, axis: int, size: int) -> np.ndarray:
    """Return the means of `size` equal stretches along an axis, float32."""
    length = image.shape[axis]
    ratio = length / size
    edges = np.arange(size + 1) * ratio
    first = np.floor(edges[:-1]).astype(np.int64)
    shape = [size if index == axis else 1 for index in range(image.ndim)]
    means = np.zeros([size if index == axis else side for index, side in enumerate(image.shape)], np.float32)
    for tap in range(int(np.ceil(ratio)) + 1):
        pixel = first + tap
        weight = (np.minimum(pixel + 1, edges[1:]) - np.maximum(pixel, edges[:-1])).clip(0) / ratio
        pixels = np.take(image, np.minimum(pixel, length - 1), axis)
        means += pixels * weight.astype(np.float32).reshape(shape)
    return means
