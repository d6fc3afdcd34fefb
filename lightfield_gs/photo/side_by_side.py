"""Two pictures in one image, side by side or one above the other: photo and depth map ("RGB-D"), or a stereo pair."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_PARTS
from lightfield_gs.io.images import as_floats
from lightfield_gs.photo.depth import DepthNumbers, grey_numbers

_NAME = re.compile(r"(^|[^a-z0-9])rgbd( ?\(\d+\))?$", re.IGNORECASE)  # (1): as browsers name a second copy


@dataclass(frozen=True)
class SideBySideConstants:
    """Thresholds of halves that are depth maps, or pictures for two eyes.

    All are chosen by hand and not tuned on a data set; tests/photo has the pictures that they must tell apart.
    """

    # Depth maps
    samples: int = 128  # pixels a side that are read: enough to see whether a half is grey
    grey: float = 0.04  # largest difference of the channels of a grey half after JPEG or video, by its range
    grey_step: float = 4 / 255  # the same by the full scale
    grey_quantile: float = 0.98  # fraction of the pixels that must be grey, where a name says that the half is a map
    # pixels at the seam where colours run over: they are stored in blocks of 16 pixels, and interpolated
    seam_px: int = 20
    relief: float = 0.05  # standard deviation of a depth map, values in 0..1, at least
    colourful: float = 0.05  # mean difference of the channels of a photo, values in 0..1, at least
    pale: float = 0.008  # the same where a name says that there is a map
    times_paler: int = 3  # the same by the map's own difference

    # Stereo pairs
    side_px: int = 64  # side of a half as it is compared
    most_parallax: float = 0.12  # parallax to either side, by the width, at most
    rows_off: int = 1  # difference of the eyes in height, pixels as compared, at most
    window_px: int = 5  # side of the windows whose differences are averaged
    least_contrast: float = 0.03  # standard deviation of a half, values in 0..1, at least
    alike: float = 0.2  # difference of the halves after parallax, by the contrast, at most
    less: float = 0.3  # by their difference when moved in height, which a repeated pattern keeps small, at most
    height_step: int = 5  # steps of these moves, pixels as compared
    same_picture: float = 0.003  # mean difference up to which the halves are one picture twice, without parallax


_C = SideBySideConstants()


def is_rgbd_name(path: Path) -> bool:
    """Return whether the name of a picture says that its depth map is in it: photo_rgbd.png."""
    return _NAME.search(path.stem) is not None


def split_halves(path: str | Path, pixels: np.ndarray, side: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the photo and the depth map, views of pixels [H, W, C].

    Args:
        path: For messages.
        pixels: [H, W, C].
        side: The side of the depth map.

    Raises:
        InputError: The side is invalid, or the pixels have no two halves.
    """
    if side not in DEPTH_PARTS:
        raise InputError(f"rgbd=: expected {', '.join(DEPTH_PARTS)}, got {side!r}")
    axis = 1 if side in ("right", "left") else 0
    size = pixels.shape[axis]
    if size % 2:
        raise InputError(
            f"{path}: expected two halves of one size, its {'height width'.split()[axis]} is {size}; cut "
            "photo and depth map apart and give the latter with depth="
        )
    first, second = np.split(pixels, 2, axis)
    return (first, second) if side in ("right", "bottom") else (second, first)


def depth_side(pixels: np.ndarray, is_named: bool = False) -> str | None:
    """Return the grey side of pixels [H, W, C] with some relief, beside a side in colour; None without one.

    Args:
        pixels: [H, W, C].
        is_named: Whether a name says that one half is a map: the photo may then be pale, if the map is less so.
    """
    height, width, channels = pixels.shape
    if channels < 3 or min(height, width) < 16:
        return None
    for side in DEPTH_PARTS:  # the first is Looking Glass's
        axis = 1 if side in ("right", "left") else 0
        if pixels.shape[axis] % 2:
            continue
        colour, grey = (
            _sample(_without_seam(half, side, part)) for part, half in enumerate(split_halves("", pixels, side))
        )
        least = max(_C.pale, _C.times_paler * float(np.ptp(grey, axis=2).mean())) if is_named else _C.colourful
        if _is_grey(grey, is_named) and grey.std() >= _C.relief and float(np.ptp(colour, axis=2).mean()) >= least:
            return side
    return None


def read_depth_half(path: str | Path, pixels: np.ndarray, side: str) -> DepthNumbers:
    """Return the numbers of the depth map in one half of a picture.

    Away from the seam it must be grey; where colours run over at the seam, its brightness counts.

    Args:
        path: For messages.
        pixels: [H, W, C].
        side: The half of the depth map.

    Raises:
        InputError: The half is in colour.
    """
    grey = split_halves(path, pixels, side)[1]
    name, inner = f"{path}: its {side} half", _without_seam(grey, side, 1)
    if grey.shape[2] < 3 or not _is_grey(as_floats(inner[..., :3]), True):
        return grey_numbers(name, grey)
    values = _luma(grey)
    if _is_grey(as_floats(inner[..., :3]), False):
        found = grey_numbers(name, inner)
        _without_seam(values[..., None], side, 1)[..., 0] = found.values
        return replace(found, values=values)
    return DepthNumbers(values, notes=["is not quite grey, as in a JPEG or a video: its brightness is taken"])


def _is_grey(values: np.ndarray, is_named: bool) -> bool:
    """Return whether values [H, W, 3] in 0..1 have next to no colour; is_named: see depth_side."""
    apart, span = _between_channels(values), float(np.ptp(values)) or 1.0
    if is_named:
        return float(np.quantile(apart, _C.grey_quantile)) <= max(_C.grey * span, _C.grey_step)
    return float(apart.max()) <= _C.grey * span


def _between_channels(values: np.ndarray) -> np.ndarray:
    """Return the largest less the smallest of the channels, [H, W]; numpy is slow along a short axis."""
    channels = [values[..., channel] for channel in range(values.shape[2])]
    return reduce(np.maximum, channels) - reduce(np.minimum, channels)


def _luma(pixels: np.ndarray) -> np.ndarray:
    """Return the luma [H, W] of pixels [H, W, 3 or more] (BT.601), in their type; of grey pixels the channel."""
    luma = pixels[..., :3] @ np.array([0.299, 0.587, 0.114])
    luma = (luma if pixels.dtype == np.float32 else np.rint(luma)).astype(pixels.dtype)
    return np.where(_between_channels(pixels[..., :3]) == 0, pixels[..., 0], luma)


def _without_seam(half: np.ndarray, side: str, part: int) -> np.ndarray:
    """Return a half [H, W, C] without the pixels at the seam, a view; part: 0 the photo, 1 the map at `side`."""
    axis = 1 if side in ("right", "left") else 0
    cut = min(_C.seam_px, half.shape[axis] // 4)
    is_second = (side in ("right", "bottom")) == (part == 1)
    keep = slice(cut, None) if is_second else slice(None, half.shape[axis] - cut)
    return half[:, keep] if axis else half[keep]


def _sample(pixels: np.ndarray) -> np.ndarray:
    steps = (max(1, size // _C.samples) for size in pixels.shape[:2])
    values = as_floats(pixels[tuple(slice(None, None, step) for step in steps)][..., :3])
    return np.clip(np.nan_to_num(values), 0, 1)


def stereo_layout(pixels: np.ndarray) -> str | None:
    """Return the arrangement of a stereo pair, "side by side" or "one above the other"; None for other pictures.

    Both halves have to show the same with a parallax that varies over the picture, or differs from none.
    """
    height, width = pixels.shape[:2]
    if min(height, width) < 32:
        return None
    for words, first, second in (
        ("side by side", pixels[:, : width // 2], pixels[:, width - width // 2 :]),
        ("one above the other", pixels[: height // 2], pixels[height - height // 2 :]),
    ):
        if _are_eyes(_reduce(first), _reduce(second)):
            return words
    return None


def _are_eyes(left: Tensor, right: Tensor) -> bool:
    contrast = float(min(left.std(), right.std()))
    if contrast < _C.least_contrast or float((left - right).abs().mean()) < _C.same_picture:
        return False
    alike = _difference(left, right)
    if alike > _C.alike * contrast:
        return False
    return all(
        alike <= _C.less * _difference(left, right.roll(rows, 0))
        for rows in range(_C.height_step, _C.side_px - 1, _C.height_step)
    )


def _difference(left: Tensor, right: Tensor) -> float:
    """Return the mean difference of two pictures [h, w] where each pixel takes its best parallax."""
    reach = round(_C.most_parallax * left.shape[1])
    shifts = itertools.product(range(-_C.rows_off, _C.rows_off + 1), range(-reach, reach + 1))
    apart = (left - torch.stack([right.roll(shift, (0, 1)) for shift in shifts])).abs()
    best = avg_pool2d(apart, _C.window_px, 1, _C.window_px // 2).amin(0)
    return float(best[_C.window_px : -_C.window_px, reach:-reach].mean())


def _reduce(pixels: np.ndarray) -> Tensor:
    """Return the brightness in 0..1 of a picture reduced to 64 x 64 pixels, float32."""
    down, across = (max(1, size // (4 * _C.side_px)) for size in pixels.shape[:2])  # a large one takes no longer
    values = np.clip(np.nan_to_num(as_floats(pixels[::down, ::across, :3])), 0, 1).mean(2)
    return interpolate(torch.from_numpy(values)[None, None], size=(_C.side_px, _C.side_px), mode="area")[0, 0]
