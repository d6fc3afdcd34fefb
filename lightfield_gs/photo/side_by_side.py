"""Two pictures in one image, side by side or one above the other: photo and depth map ("RGB-D"), or a stereo pair."""

from __future__ import annotations

import re
from dataclasses import replace
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
_SAMPLES = 128  # pixels a side that are looked at: enough to see whether a half is grey
# How far the channels of a grey half come apart when it is saved as JPEG or as a video: as a share of its range, or of
# the full scale; and the share of its pixels in which they do not, where something says that it is a map
_GREY, _GREY_STEP, _MOST_GREY = 0.04, 4 / 255, 0.98
# At the seam of such a picture the colours of the photo run over into the map: they are stored in blocks of 16 pixels,
# and interpolated
_SEAM_PX = 20
# The least standard deviation of a depth map, and the least mean difference of the channels of a photo, values in 0..1
_RELIEF, _COLOURFUL = 0.05, 0.05
# The same of the photo where a name says that there is a map: more than that, and so many times the map's own
_PALE, _TIMES_PALER = 0.008, 3


def is_rgbd_name(path: Path) -> bool:
    """Whether the name of a picture says that its depth map is in it: photo_rgbd.png."""
    return _NAME.search(path.stem) is not None


def split_halves(path: str | Path, pixels: np.ndarray, side: str) -> tuple[np.ndarray, np.ndarray]:
    """The photo and the depth map, views of pixels [H, W, C]; side: of the latter. Raises InputError."""
    if side not in DEPTH_PARTS:
        raise InputError(f"--rgbd: expected {', '.join(DEPTH_PARTS)}, got {side!r}")
    axis = 1 if side in ("right", "left") else 0
    size = pixels.shape[axis]
    if size % 2:
        raise InputError(
            f"{path}: expected two halves of one size, its {'height width'.split()[axis]} is {size}; cut "
            "photo and depth map apart and give the latter with --depth"
        )
    parts = pixels.swapaxes(0, axis)
    first, second = (part.swapaxes(0, axis) for part in (parts[: size // 2], parts[size // 2 :]))
    return (first, second) if side in ("right", "bottom") else (second, first)


def depth_side(pixels: np.ndarray, is_named: bool = False) -> str | None:
    """Which half of pixels [H, W, C] is grey, with some relief, beside one in colour; None where no half is.

    is_named: whether something says that one is a map: then the photo may be pale, if the map is less so.
    """
    height, width, channels = pixels.shape
    if channels < 3 or min(height, width) < 16:
        return None
    for side in DEPTH_PARTS:  # the first is Looking Glass's
        axis = 1 if side in ("right", "left") else 0
        if pixels.shape[axis] % 2:
            continue
        colour, grey = (
            _sampled(_off_seam(half, side, part)) for part, half in enumerate(split_halves("", pixels, side))
        )
        least = max(_PALE, _TIMES_PALER * float(np.ptp(grey, axis=2).mean())) if is_named else _COLOURFUL
        if _is_grey(grey, is_named) and grey.std() >= _RELIEF and float(np.ptp(colour, axis=2).mean()) >= least:
            return side
    return None


def read_depth_half(path: str | Path, pixels: np.ndarray, side: str) -> DepthNumbers:
    """The numbers of the depth map in the half `side` of pixels [H, W, C]. Raises InputError.

    Whether it is grey is judged away from the seam; where colours run over there, its brightness is taken.
    """
    grey = split_halves(path, pixels, side)[1]
    name, inner = f"{path}: its {side} half", _off_seam(grey, side, 1)
    if grey.shape[2] < 3 or not _is_grey(as_floats(inner[..., :3]), True):
        return grey_numbers(name, grey)
    values = _brightness(grey)
    if _is_grey(as_floats(inner[..., :3]), False):
        found = grey_numbers(name, inner)
        _off_seam(values[..., None], side, 1)[..., 0] = found.values
        return replace(found, values=values)
    return DepthNumbers(values, notes=["is not quite grey, as in a JPEG or a video: its brightness is taken"])


def _is_grey(values: np.ndarray, is_named: bool) -> bool:
    """Whether values [H, W, 3] in 0..1 have next to no colour; is_named: see depth_side."""
    apart, span = np.ptp(values, axis=2), float(np.ptp(values)) or 1.0
    if is_named:
        return float(np.quantile(apart, _MOST_GREY)) <= max(_GREY * span, _GREY_STEP)
    return float(apart.max()) <= _GREY * span


def _brightness(pixels: np.ndarray) -> np.ndarray:
    """The luma [H, W] of pixels [H, W, 3 or more] (BT.601, as in JPEG), in their type; of grey ones the channels."""
    luma = pixels[..., :3] @ np.array([0.299, 0.587, 0.114])
    luma = (luma if pixels.dtype == np.float32 else np.rint(luma)).astype(pixels.dtype)
    return np.where(np.ptp(pixels[..., :3], axis=2) == 0, pixels[..., 0], luma)


def _off_seam(half: np.ndarray, side: str, part: int) -> np.ndarray:
    """A half [H, W, C] without the pixels at the seam, a view; part: 0 the photo, 1 the map at `side`."""
    axis = 1 if side in ("right", "left") else 0
    cut = min(_SEAM_PX, half.shape[axis] // 4)
    is_second = (side in ("right", "bottom")) == (part == 1)
    keep = slice(cut, None) if is_second else slice(None, half.shape[axis] - cut)
    return half[:, keep] if axis else half[keep]


def _sampled(pixels: np.ndarray) -> np.ndarray:
    steps = (max(1, size // _SAMPLES) for size in pixels.shape[:2])
    values = as_floats(pixels[tuple(slice(None, None, step) for step in steps)][..., :3])
    return np.clip(np.nan_to_num(values), 0, 1)


_SIDE_PX = 64  # of a half as it is compared
_MOST_PARALLAX = 0.12  # of its width, to either side
_ROWS_OFF = 1  # that the eyes may be off in height, pixels as compared
_WINDOW_PX = 5  # whose differences are averaged
_LEAST_CONTRAST = 0.03  # standard deviation of a half, values in 0..1
# The halves have to differ by so little where parallax is made up for, as a share of the contrast, and by so much less
# than they do from each other moved up by any so many pixels, where a picture of a pattern is as much like itself
_ALIKE, _LESS, _STEP = 0.2, 0.3, 5
_SAME = 0.003  # mean difference up to which the halves are the same picture twice, of no parallax


def stereo_layout(pixels: np.ndarray) -> str | None:
    """How the two eyes of a stereo pair lie in pixels [H, W, C], "side by side" or "one above the other"; None for all
    other pictures, as far as can be told.

    Both halves have to show the same with a parallax that differs from place to place or from none.
    """
    height, width = pixels.shape[:2]
    if min(height, width) < 32:
        return None
    for words, first, second in (
        ("side by side", pixels[:, : width // 2], pixels[:, width - width // 2 :]),
        ("one above the other", pixels[: height // 2], pixels[height - height // 2 :]),
    ):
        if _are_eyes(_reduced(first), _reduced(second)):
            return words
    return None


def _are_eyes(left: Tensor, right: Tensor) -> bool:
    contrast = float(min(left.std(), right.std()))
    if contrast < _LEAST_CONTRAST or float((left - right).abs().mean()) < _SAME:
        return False
    alike = _difference(left, right)
    if alike > _ALIKE * contrast:
        return False
    return all(alike <= _LESS * _difference(left, right.roll(rows, 0)) for rows in range(_STEP, _SIDE_PX - 1, _STEP))


def _difference(left: Tensor, right: Tensor) -> float:
    """Mean difference of two pictures [h, w] where each place takes the parallax that suits it best."""
    reach = round(_MOST_PARALLAX * left.shape[1])
    shifts = [(down, across) for down in range(-_ROWS_OFF, _ROWS_OFF + 1) for across in range(-reach, reach + 1)]
    apart = (left - torch.stack([right.roll(shift, (0, 1)) for shift in shifts])).abs()
    best = avg_pool2d(apart, _WINDOW_PX, 1, _WINDOW_PX // 2).amin(0)
    return float(best[_WINDOW_PX:-_WINDOW_PX, reach:-reach].mean())


def _reduced(pixels: np.ndarray) -> Tensor:
    """Brightness in 0..1 of a picture reduced to 64 x 64 pixels, float32."""
    down, across = (max(1, size // (4 * _SIDE_PX)) for size in pixels.shape[:2])  # a large one takes no longer
    values = np.clip(np.nan_to_num(as_floats(pixels[::down, ::across, :3])), 0, 1).mean(2)
    return interpolate(torch.from_numpy(values)[None, None], size=(_SIDE_PX, _SIDE_PX), mode="area")[0, 0]
