"""A photo and its depth map in one picture, side by side or one above the other ("RGB-D", as Looking Glass has it)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEPTH_PARTS
from lightfield_gs.io.images import as_floats
from lightfield_gs.photo.depth_files import channels_apart

_NAME = re.compile(r"(^|[^a-z0-9])rgbd$", re.IGNORECASE)
_SAMPLES = 128  # pixels a side that are looked at: enough to see whether a half is grey
_GREY = 0.04  # how far the channels of a grey half come apart when it is saved as JPEG, as a share of its range
# The least standard deviation of a depth map, and the least mean difference of the channels of a photo, values in 0..1
_RELIEF, _COLOURFUL = 0.05, 0.05


def is_named_so(path: Path) -> bool:
    """Whether the name of a picture says that its depth map is in it: photo_rgbd.png."""
    return _NAME.search(path.stem) is not None


def halves(path: str | Path, pixels: np.ndarray, side: str) -> tuple[np.ndarray, np.ndarray]:
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


def depth_side(pixels: np.ndarray) -> str | None:
    """Which half of pixels [H, W, C] is grey, with some relief, beside one in colour; None where no half is."""
    height, width, channels = pixels.shape
    if channels < 3 or min(height, width) < 16:
        return None
    for side in DEPTH_PARTS:  # the first is Looking Glass's
        axis = 1 if side in ("right", "left") else 0
        if pixels.shape[axis] % 2:
            continue
        colour, grey = (_sampled(half) for half in halves("", pixels, side))
        is_grey = all(channels_apart(grey, *pair) <= _GREY for pair in ((0, 1), (0, 2), (1, 2)))  # mostly not the first
        if is_grey and grey.std() >= _RELIEF and float(np.ptp(colour, axis=2).mean()) >= _COLOURFUL:
            return side
    return None


def _sampled(pixels: np.ndarray) -> np.ndarray:
    steps = (max(1, size // _SAMPLES) for size in pixels.shape[:2])
    values = as_floats(pixels[tuple(slice(None, None, step) for step in steps)][..., :3])
    return np.clip(np.nan_to_num(values), 0, 1)
