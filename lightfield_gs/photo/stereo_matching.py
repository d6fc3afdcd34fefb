"""Depth by matching the pictures of two eyes: semi-global matching, checked from both sides, with the photo's edges."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.photo.joint_upsampling import percentiles, upsample


class PairMismatch(InputError):
    """Two pictures are not those of two eyes."""


@dataclass(frozen=True)
class MatchingConstants:
    """Sizes and thresholds of matching.

    All are chosen by hand on made-up scenes of tests/photo and not tuned on a data set.
    """

    most_px: int = 600_000  # pixels of an eye's picture as it is matched
    coarse_px: int = 320  # its width where the range of the parallax is looked for
    most_parallax: float = 0.2  # parallax to either side, by the width, at most
    range_percentile: float = 0.5  # of the coarse parallaxes, at both ends, that may be errors
    range_margin: float = 0.15  # beyond these ends, by the range
    block_px: int = 5  # side of the blocks that are compared
    smooth_weak: int = 8  # cost of a step of one, by channels and the area of a block
    smooth_strong: int = 32  # cost of a larger step
    same_px: float = 1.5  # difference of the parallaxes from both sides, at most
    least_matched: float = 0.45  # fraction of the pixels that must match from both sides
    least_textured: float = 4.0  # standard deviation, of 255 levels, below which nothing can be matched
    features: int = 3000  # points by which the eyes' pictures are made level
    least_pairs: int = 40  # pairs of points without which they are taken as level
    level_px: float = 1.5  # difference in height of a pair that fits, pixels as matched
    least_off_px: float = 0.6  # difference in height anywhere below which nothing is changed


_C = MatchingConstants()
_INSTALL = "pip install 'lightfield-gs[stereo]'"


@dataclass
class Parallax:
    """What two eyes' pictures say of depth.

    Attributes:
        shifts: x_left - x_right of each pixel of the left eye's picture, float32 [H, W], in its pixels.
        right_shifts: The same of the right eye's, levelled.
        right: The right eye's picture, levelled, uint8 [H, W, 3].
        matched: Fraction of the pixels that match from both sides.
        raised_px: Largest difference in height that was taken out, pixels.
    """

    shifts: np.ndarray
    right_shifts: np.ndarray
    right: np.ndarray
    matched: float
    raised_px: float

    @classmethod
    def unmatched(cls, right: np.ndarray) -> Parallax:
        """Return no parallax, of pictures that do not match; right: uint8 [H, W, 3]."""
        none = np.zeros(right.shape[:2], np.float32)
        return cls(none, none, right, 0.0, 0.0)


def cv_library() -> Any:
    """Return OpenCV; raise InputError where it is not installed."""
    try:
        import cv2
    except ImportError as error:
        raise InputError(
            f"OpenCV, which matches the eyes' pictures, could not be imported ({error}): {_INSTALL}; or give the "
            "depth with depth=FILE, or stereo_in=none to take one eye's picture alone"
        ) from None
    return cv2


def match_eyes(name: str, left: np.ndarray, right: np.ndarray) -> Parallax:
    """Match the pictures of two eyes.

    The right one is made level first, by points that both show. Each pixel then gets the parallax of semi-global
    matching (Hirschmueller, "Stereo processing by semiglobal matching and mutual information", 2008) where both eyes
    agree on it. What only one eye sees gets that of the farther neighbour in its row. Edges go where the photo has
    them, as with estimated depths.

    Args:
        name: For messages.
        left: uint8 [H, W, 3], upright.
        right: Of the same size.

    Raises:
        InputError: OpenCV is missing.
        PairMismatch: The pictures do not match.
    """
    cv2 = cv_library()
    height, width = left.shape[:2]
    scale = min(1.0, math.sqrt(_C.most_px / (height * width)))
    size = max(16, round(scale * width)), max(16, round(scale * height))
    level, raised = _levelled(cv2, left, right, scale)
    small = [cv2.resize(eye, size, interpolation=cv2.INTER_AREA) if scale < 1 else eye for eye in (left, level)]
    if min(float(eye.std()) for eye in small) < _C.least_textured:
        raise PairMismatch(f"{name}: the eyes' pictures are (nearly) of one colour, and cannot be matched; {_WAYS}")
    agreed = _both_ways(cv2, small, *_range(cv2, *small))
    matched = float(np.isfinite(agreed[0]).mean())
    if matched < _C.least_matched:
        raise PairMismatch(
            f"{name}: the eyes' pictures do not match (only {matched:.0%} of it is alike in both); {_WAYS}"
        )
    shifts, right_shifts = (_at_full_size(_filled(cv2, part), eye, size[0]) for part, eye in zip(agreed, (left, level)))
    return Parallax(shifts, right_shifts, level, matched, raised)


_WAYS = (
    "are they one above the other, or crossed (stereo_in=, swap_eyes=True)? Else give depth=FILE, or stereo_in=none to "
    "take one picture alone"
)


def _levelled(cv2: Any, left: np.ndarray, right: np.ndarray, scale: float) -> tuple[np.ndarray, float]:
    """Return the right picture with its rows at the heights of the left one's, and the largest change in pixels.

    The heights differ by a + b x + c y: offset, roll and size.
    """
    height, width = left.shape[:2]
    finder = cv2.ORB_create(_C.features, fastThreshold=8)
    found = []
    for eye in (left, right):
        grey = cv2.cvtColor(eye, cv2.COLOR_RGB2GRAY)
        found.append(finder.detectAndCompute(cv2.resize(grey, None, fx=scale, fy=scale), None))
    (points, words), (others, other_words) = found
    if words is None or other_words is None:
        return right, 0.0
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(words, other_words)
    ends = np.array([(*points[pair.queryIdx].pt, *others[pair.trainIdx].pt) for pair in pairs], np.float64)
    if len(ends) < _C.least_pairs:
        return right, 0.0
    most = _C.most_parallax * scale * width
    near = (np.abs(ends[:, 0] - ends[:, 2]) < most) & (np.abs(ends[:, 1] - ends[:, 3]) < most / 2)
    ends = ends[near]
    # Positions in the right picture, at full size, and how much lower the left picture shows them
    x, y, off = ends[:, 2] / scale, ends[:, 3] / scale, (ends[:, 1] - ends[:, 3]) / scale
    terms = np.stack([np.ones_like(x), x / width - 0.5, y / height - 0.5], 1)
    fits = np.abs(off - np.median(off)) < 4 * _C.level_px / scale if len(off) else np.zeros(0, bool)
    for _ in range(5):
        if fits.sum() < _C.least_pairs:
            return right, 0.0
        plane = np.linalg.lstsq(terms[fits], off[fits], rcond=None)[0]
        fits = np.abs(off - terms @ plane) < _C.level_px / scale
    if fits.sum() < _C.least_pairs:
        return right, 0.0
    raised = float(abs(plane[0]) + abs(plane[1]) / 2 + abs(plane[2]) / 2)
    if raised * scale < _C.least_off_px:
        return right, 0.0
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    lower = plane[0] + plane[1] * (columns / width - 0.5) + plane[2] * (rows / height - 0.5)
    source = (rows - lower).astype(np.float32)
    return cv2.remap(right, columns, source, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), raised


def _range(cv2: Any, left: np.ndarray, right: np.ndarray) -> tuple[int, int]:
    """Return the least and the largest parallax in pixels, found on small pictures."""
    width = left.shape[1]
    shrink = min(1.0, _C.coarse_px / width)
    small = [cv2.resize(eye, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) for eye in (left, right)]
    most = round(_C.most_parallax * small[0].shape[1])
    agreed = _both_ways(cv2, small, -most, most)[0]
    known = agreed[np.isfinite(agreed)]
    if not known.size:
        return round(-_C.most_parallax * width), round(_C.most_parallax * width)
    low, high = np.percentile(known, [_C.range_percentile, 100 - _C.range_percentile])
    more = _C.range_margin * (high - low) + 2
    return math.floor((low - more) / shrink), math.ceil((high + more) / shrink)


def _match_rows(cv2: Any, left: np.ndarray, right: np.ndarray, low: int, high: int) -> np.ndarray:
    """Return the parallax x_left - x_right of each pixel of the left picture, NaN where none fits."""
    count = 16 * math.ceil((high - low + 1) / 16)
    area = 3 * _C.block_px**2
    matcher = cv2.StereoSGBM_create(
        minDisparity=low,
        numDisparities=count,
        blockSize=_C.block_px,
        P1=_C.smooth_weak * area,
        P2=_C.smooth_strong * area,
        preFilterCap=31,
        mode=cv2.STEREO_SGBM_MODE_SGBM,
    )
    # Beyond the border, so that pixels near it can match too
    side = max(abs(low), abs(low + count)) + _C.block_px
    padded = [cv2.copyMakeBorder(eye, 0, 0, side, side, cv2.BORDER_REPLICATE) for eye in (left, right)]
    found = matcher.compute(*padded)[:, side:-side].astype(np.float32) / 16
    found[found < low] = np.nan
    columns = np.arange(left.shape[1], dtype=np.float32) - found
    found[(columns < -0.5) | (columns > left.shape[1] - 0.5)] = np.nan
    return found


def _both_ways(cv2: Any, eyes: list[np.ndarray], low: int, high: int) -> list[np.ndarray]:
    """Return the parallaxes of the left and of the right picture, NaN where the other one does not confirm them."""
    left, right = eyes
    own = _match_rows(cv2, left, right, low, high)
    # Mirrored, the right picture is the left one
    turned = [np.ascontiguousarray(eye[:, ::-1]) for eye in (right, left)]
    other = np.ascontiguousarray(_match_rows(cv2, turned[0], turned[1], low, high)[:, ::-1])
    return [_agreed(own, other, -1), _agreed(other, own, 1)]


def _agreed(own: np.ndarray, other: np.ndarray, sign: int) -> np.ndarray:
    """Return the parallaxes of a picture that the other one confirms, NaN elsewhere; sign: -1 for the left one."""
    height, width = own.shape
    rows, columns = np.mgrid[:height, :width]
    there = columns + sign * np.nan_to_num(own)
    there = np.rint(there).astype(int).clip(0, width - 1)
    same = np.abs(other[rows, there] - own) <= _C.same_px
    return np.where(same, own, np.float32(np.nan))


def _filled(cv2: Any, shifts: np.ndarray) -> np.ndarray:
    """Return the parallaxes with the farther neighbour's in the row where there is none, without single specks."""
    low = float(np.nanmin(shifts)) - 1
    known = np.where(np.isfinite(shifts), shifts, low).astype(np.float32)
    rows = np.arange(len(known))[:, None]
    columns = np.arange(known.shape[1])
    is_known = known > low
    before = np.maximum.accumulate(np.where(is_known, columns, -1), 1)
    after = np.minimum.accumulate(np.where(is_known, columns, known.shape[1])[:, ::-1], 1)[:, ::-1]
    values = [
        np.where(inside, known[rows, place.clip(0, known.shape[1] - 1)], np.inf)
        for place, inside in ((before, before >= 0), (after, after < known.shape[1]))
    ]
    farther = np.minimum(*values)
    # Rows without any: those of the nearest row
    empty = ~np.isfinite(farther[:, 0])
    if empty.any():
        full = np.flatnonzero(~empty)
        nearest = full[np.abs(np.arange(len(known))[:, None] - full[None]).argmin(1)]
        farther = farther[nearest]
    return cv2.medianBlur(np.where(is_known, known, farther).astype(np.float32), 5)


def _at_full_size(shifts: np.ndarray, eye: np.ndarray, width: int) -> np.ndarray:
    """Return parallaxes at the size of their picture, in its pixels, with its edges."""
    values = torch.from_numpy(np.ascontiguousarray(shifts))
    low, high = percentiles(values)
    photo = torch.from_numpy(eye).float() / 255
    return upsample(values, photo, max(high - low, 1.0)).numpy() * np.float32(eye.shape[1] / width)
