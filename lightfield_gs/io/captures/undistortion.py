"""Undistort and reduce images."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import Lens, describe_coefficients, distort_brown

LARGEST_FOLDED_FRACTION = 0.25  # share of a picture that a lens may fold away: more is a mistake in its numbers
_BAND = 256  # rows at a time: in float64 a whole photograph would take 100 bytes a pixel
_LEAST_ALPHA = 1e-3  # of 255: less, after rounding of float32, is none
_RAYS, _STEPS = 32, 2048  # where a lens is looked at for the place from which on it folds


def brown_source_positions(
    intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int
) -> np.ndarray:
    """Where in the stored picture each pixel of the undistorted one is, [H,W,2] float64: x and y in pixels from the
    outer corner of the first; NaN where the polynomial folds the plane, so that no lens shows what is there.

    Both pictures have the intrinsics (fx, fy, cx, cy) and the size width_px x height_px.
    """
    columns, rows = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    points = (np.stack([columns, rows], -1) - intrinsics[2:]) / intrinsics[:2]
    with np.errstate(over="ignore", invalid="ignore"):
        places = distort_brown(points, coefficients) * intrinsics[:2] + intrinsics[2:]
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
    lost = np.isnan(_coarse_source_positions(intrinsics, coefficients, width_px, height_px)).any(-1).mean()
    if lost > LARGEST_FOLDED_FRACTION:
        raise InputError(
            f"{field}: bad intrinsics: the lens distortion {describe_coefficients(coefficients)} folds {lost:.0%} of "
            "the picture onto the rest: expected coefficients for lengths in units of the focal length; or "
            "undistort the images first and leave them out"
        )


def fraction_beyond(intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int) -> float:
    """The share 0..1 of the stored picture that lies beyond the frame of the undistorted one, to some 2 %."""
    places = _coarse_source_positions(intrinsics, coefficients, width_px, height_px)
    height, width = np.maximum(np.array(places.shape[:2]) // 2, 1)
    cells = np.floor(places[~np.isnan(places).any(-1)] / 2).astype(int)  # of four pixels, so that few are leapt over
    cells = cells[((cells >= 0) & (cells < (width, height))).all(-1)]
    return 1 - len(np.unique(cells @ (1, width))) / (width * height)


def _coarse_source_positions(
    intrinsics: np.ndarray, coefficients: np.ndarray, width_px: int, height_px: int
) -> np.ndarray:
    """brown_source_positions of a picture of some 128 pixels a side: enough to measure areas."""
    scale = 128 / max(width_px, height_px)
    width, height = (max(2, round(side * scale)) for side in (width_px, height_px))
    return brown_source_positions(intrinsics * scale, coefficients, width, height)


def undistort(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """A picture uint8 [H,W,C] looked up at places [H,W,2] of brown_source_positions, bilinearly; 0 beyond its edges."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((1, 2), (1, 2), (0, 0))).astype(np.float32)
    inside = np.nan_to_num(np.clip(places, -0.5, (width + 0.5, height + 0.5)), nan=-0.5) + 0.5  # pixel centres, padded
    first = np.floor(inside).astype(np.int64)
    x, y = np.moveaxis(first, -1, 0)
    right, down = np.moveaxis((inside - first).astype(np.float32)[..., None], -2, 0)
    upper = padded[y, x] * (1 - right) + padded[y, x + 1] * right
    lower = padded[y + 1, x] * (1 - right) + padded[y + 1, x + 1] * right
    return np.rint(upper * (1 - down) + lower * down).astype(np.uint8)


def source_positions(
    lens: Lens, intrinsics: np.ndarray, width_px: int, height_px: int, rows: range | None = None
) -> np.ndarray:
    """Where in the photograph each pixel of a pinhole's picture is, [H,W,2] float64: x and y in pixels from the outer
    corner of the first; NaN where the lens folds the plane, so that it does not show what is there.

    Both pictures have the intrinsics [4] (fx, fy, cx, cy) and this size. rows: those alone.
    """
    y, x = np.meshgrid(
        np.arange(height_px)[range(height_px) if rows is None else rows] + 0.5, np.arange(width_px) + 0.5
    )
    points = (np.stack([x.T, y.T], -1) - intrinsics[2:]) / intrinsics[:2]
    places = lens.distorted(points) * intrinsics[:2] + intrinsics[2:]
    corners = (np.array([(0, 0), (0, height_px), (width_px, 0), (width_px, height_px)]) - intrinsics[2:]) / intrinsics[
        :2
    ]
    fold = fold_radius(lens, float(np.linalg.norm(corners, axis=1).max()))
    beyond = points[..., 0] ** 2 + points[..., 1] ** 2 >= fold**2  # numpy is slow at sums of two
    places[beyond | ~np.isfinite(places[..., 0] + places[..., 1])] = np.nan
    return places


@lru_cache(maxsize=16)  # of the bands of one picture
def fold_radius(lens: Lens, largest: float) -> float:
    """The radius at depth 1, up to `largest`, from which on the lens shows a point further out nearer to the middle
    than one before it; infinity where there is none. To a thousandth of `largest`."""
    angles = np.arange(_RAYS) * (2 * np.pi / _RAYS)
    outward = np.stack([np.cos(angles), np.sin(angles)], -1)[:, None]
    radii = np.linspace(0, largest, _STEPS)
    along = (lens.distorted(outward * radii[:, None]) * outward).sum(-1)
    with np.errstate(invalid="ignore"):
        grows = (np.diff(along, axis=1) > 0).all(0)
    return np.inf if grows.all() else float(radii[grows.argmin()])


def folded_fraction(lens: Lens, intrinsics: np.ndarray, width_px: int, height_px: int) -> float:
    """The share 0..1 of the pinhole's picture that the lens does not show at all, to some 2 %."""
    scale = 128 / max(width_px, height_px)
    width, height = (max(2, round(side * scale)) for side in (width_px, height_px))
    ratio = np.array([width / width_px, height / height_px] * 2)
    return float(np.isnan(source_positions(lens, intrinsics * ratio, width, height)).any(-1).mean())


@lru_cache(maxsize=2)  # photographs of one camera follow each other
def straightening(lens: Lens, intrinsics: tuple[float, ...], width_px: int, height_px: int) -> Straightening:
    """What takes the lens out of photographs of this size; intrinsics: (fx, fy, cx, cy) of the pinhole, too."""
    return Straightening(lens, np.array(intrinsics), width_px, height_px)


class Straightening:
    """Pictures of one camera without its lens. frame: uint8 [H,W], 255 within the distorted photograph and 0 beyond;
    None where all is within."""

    def __init__(self, lens: Lens, intrinsics: np.ndarray, width_px: int, height_px: int):
        import torch

        shares = np.empty((1, height_px, width_px, 2), np.float32)  # -1..1 across the photograph, as grid_sample wants
        frame = np.empty((height_px, width_px), np.uint8)
        for top in range(0, height_px, _BAND):
            rows = range(top, min(top + _BAND, height_px))
            places = source_positions(lens, intrinsics, width_px, height_px, rows)
            good = (places >= 0) & (places <= (width_px, height_px))  # false for NaN
            inside = good[..., 0] & good[..., 1]
            frame[rows] = np.where(inside, 255, 0)
            shares[0, rows] = np.nan_to_num(places / (width_px, height_px) * 2 - 1)
        self.frame: np.ndarray | None = None if frame.all() else frame
        self.grid = torch.from_numpy(shares)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """A photograph [H,W,C], or [H,W], without its lens, bilinearly; beyond its edges it is as these are. uint8, or
        float32 of any range."""
        import torch

        planes = torch.from_numpy(np.ascontiguousarray(image)).reshape(*image.shape[:2], -1)
        planes = planes.permute(2, 0, 1)[None].float()
        found = torch.nn.functional.grid_sample(planes, self.grid, "bilinear", "border", align_corners=False)
        if image.dtype == np.uint8:
            found = found.round_().clamp_(0, 255).to(torch.uint8)
        return found[0].permute(1, 2, 0).reshape(image.shape).numpy()


def reduced(image: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """A picture [H,W,...], uint8 or float32, made as small as this: each pixel is the mean over its own area of it."""
    found = image
    for axis, size in ((0, height_px), (1, width_px)):
        if found.shape[axis] != size:
            found = _reduced_along(found, axis, size)
    return found if found.dtype == image.dtype else np.rint(found).clip(0, 255).astype(np.uint8)


def resampled(image: np.ndarray, lens: Straightening | None, width_px: int, height_px: int) -> np.ndarray:
    """The colours uint8 [H,W,3] of a photograph uint8 [H,W,3 or 4] without its lens, as small as this.

    Colours with alpha are weighed by it (Porter & Duff, "Compositing digital images", 1984): what is transparent has a
    colour in the file that nobody is to see, and none of it gets into the edges. All transparent pixels are black.
    """
    size = (width_px, height_px)
    if lens is None and image.shape[1::-1] == size:
        return image[..., :3]
    if image.shape[2] == 3 or image[..., 3].min() == 255:
        colours = image[..., :3]
        return reduced(colours if lens is None else lens(colours), *size)
    weighed = image.astype(np.float32)
    weighed[..., :3] *= weighed[..., 3:] / 255
    weighed = reduced(weighed if lens is None else lens(weighed), *size)
    colours = weighed[..., :3] * 255 / np.maximum(weighed[..., 3:], _LEAST_ALPHA)
    return np.rint(colours).clip(0, 255).astype(np.uint8)


def _reduced_along(image: np.ndarray, axis: int, size: int) -> np.ndarray:
    """Means of `size` equal stretches along an axis, float32."""
    length = image.shape[axis]
    ratio = length / size
    edges = np.arange(size + 1) * ratio
    first = np.floor(edges[:-1]).astype(np.int64)
    shape = [size if place == axis else 1 for place in range(image.ndim)]
    means = np.zeros([size if place == axis else side for place, side in enumerate(image.shape)], np.float32)
    for tap in range(int(np.ceil(ratio)) + 1):
        pixel = first + tap
        share = (np.minimum(pixel + 1, edges[1:]) - np.maximum(pixel, edges[:-1])).clip(0) / ratio
        pixels = np.take(image, np.minimum(pixel, length - 1), axis)
        means += pixels * share.astype(np.float32).reshape(shape)
    return means
