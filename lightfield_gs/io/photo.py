"""A photo as RGBA: one object cut out, whatever way the cut-out is given, or the whole picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lightfield_gs.checks import expect
from lightfield_gs.errors import InputError
from lightfield_gs.io.background import background_removed
from lightfield_gs.io.images import read_image

_BORDER_SHARE = 0.02  # of the shorter side, at least one pixel: what has to be plain
_PLAIN_STD = 0.04  # largest spread of the border's colour, but for its outliers
_PLAIN_SHARE = 0.9  # of the border pixels that must be near the background's colour
_NEAR, _FAR = 0.06, 0.14  # colour distances between which the mask rises from 0 to 1
_SAME = 0.02  # colour distance below which an enclosed patch is the background, seen through a hole ...
_PATCH_SHARE = 0.025  # ... if a square of this share of the shorter side fits in it: smaller ones are highlights
_MIN_OBJECT_SHARE = 0.001  # of the pixels
_OTHER_CUT_OUTS = ("give RGBA, a cut-out with --mask FILE, or --remove-background (pip install "
                   "'lightfield-gs[rembg]')")


def load_photo(path: str | Path, mask: str | Path | None = None, *, remove_background: bool = False,
               whole: bool = False) -> np.ndarray:
    """The photo as float32 RGBA [H, W, 4] in 0..1, upright, alpha straight: 1 on the object, 0 beside it.

    The cut-out is `mask` (an image of the photo's size: its alpha, else its brightness), or with `remove_background`
    what the package rembg finds, else the photo's own alpha, else what stands out from a plain background; or
    everything, with `whole`. Raises InputError when there is none of these, or nothing in it.
    """
    expect("remove_background", remove_background, bool)
    expect("whole", whole, bool)
    if mask is not None and remove_background:
        raise InputError("--mask and --remove-background are two ways to the same cut-out; leave out one of them")
    pixels = read_image(path)
    if not np.isfinite(pixels).all():
        raise InputError(f"{path} has pixels that are not finite; export it as 8- or 16-bit")
    rgb, alpha = _colour_and_alpha(np.clip(pixels, 0, 1))
    if mask is not None:
        alpha = _read_mask(mask, rgb.shape[:2])
        empty = f"{mask}: nothing is cut out, the mask is (nearly) empty; give another"
    elif remove_background:
        alpha = background_removed(rgb)
        empty = f"{path}: rembg found no object; give a cut-out with --mask FILE"
    elif alpha is not None and alpha.min() < 1:
        empty = f"{path}: nothing is cut out, its alpha is (nearly) empty; give another photo or --mask FILE"
    else:
        alpha = np.ones(rgb.shape[:2], np.float32) if whole else plain_background_mask(rgb)
        empty = f"{path}: its background looks plain and nothing stands out from it; {_OTHER_CUT_OUTS}"
        if alpha is None:
            raise InputError(f"{path} has no cut-out and no plain background; to show one object, {_OTHER_CUT_OUTS}; "
                             "to show the whole scene, give its distances with --depth FILE")
    if (alpha > 0.5).mean() < _MIN_OBJECT_SHARE:
        raise InputError(empty)
    return np.concatenate([rgb, alpha[..., None]], 2).astype(np.float32)


def _colour_and_alpha(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """RGB [H, W, 3] and alpha [H, W] or None of 1 (grey), 2 (grey, alpha), 3 or 4 and more channels."""
    channels = pixels.shape[2]
    rgb = np.repeat(pixels[..., :1], 3, 2) if channels < 3 else pixels[..., :3]
    if channels == 2:
        return rgb, pixels[..., 1]
    return rgb, pixels[..., 3] if channels >= 4 else None


def _read_mask(path: str | Path, size: tuple[int, int]) -> np.ndarray:
    rgb, alpha = _colour_and_alpha(read_image(path))
    if rgb.shape[:2] != size:
        raise InputError(f"{path}: expected a mask of the photo's size {size[1]} x {size[0]}, "
                         f"got {rgb.shape[1]} x {rgb.shape[0]}")
    mask = rgb.mean(2) if alpha is None or alpha.min() >= 1 else alpha
    if not np.isfinite(mask).all():
        raise InputError(f"{path} has pixels that are not finite; export it as 8- or 16-bit")
    return np.clip(mask, 0, 1)


def plain_background_mask(rgb: np.ndarray) -> np.ndarray | None:
    """Alpha [H, W] of what stands out from the plain background of `rgb` [H, W, 3], or None where it is not plain.

    The background is what is near the border's colour and connected to the border, or to a patch of just that colour
    that is large enough to be a hole of the object (a handle); smaller spots inside the object stay opaque. The edge is
    soft, rising with the distance in colour.
    """
    height, width = rgb.shape[:2]
    thick = max(1, round(_BORDER_SHARE * min(height, width)))
    if min(height, width) < 8:
        return None
    inner = np.zeros((height, width), bool)
    inner[thick:-thick, thick:-thick] = True
    border = rgb[~inner]
    colour = np.median(border, 0)
    near = np.linalg.norm(border - colour, axis=1) < _NEAR + _PLAIN_STD
    if near.mean() < _PLAIN_SHARE or border[near].std(0).max() > _PLAIN_STD:
        return None
    distance = np.linalg.norm(rgb - border[near].mean(0), axis=2)
    seeds = ~inner | _large_patches(distance < _SAME, max(3, round(_PATCH_SHARE * min(height, width))))
    outside = _connected(seeds, distance < _FAR)
    return np.where(outside, np.clip((distance - _NEAR) / (_FAR - _NEAR), 0, 1), 1.0)


def _large_patches(flags: np.ndarray, side: int) -> np.ndarray:
    """The pixels [H, W] at whose lower right a square of `side` pixels is all set."""
    total = np.pad(flags.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    full = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side] == side * side
    return np.pad(full, ((0, side - 1), (0, side - 1)))


def _connected(seeds: np.ndarray, passable: np.ndarray) -> np.ndarray:
    """The pixels [H, W] that a 4-connected path through `passable` joins to a seed.

    Sweeps along rows and columns until nothing changes: each sweep fills whole runs.
    """
    reached = seeds & passable
    runs = [(_run_labels(p), p) for p in (passable, passable.T)]
    count = -1
    while count != (count := int(reached.sum())):
        for (labels, open_), view in zip(runs, (reached, reached.T)):
            hit = np.zeros(labels.max() + 1, bool)
            hit[labels[view]] = True
            view |= hit[labels] & open_
    return reached


def _run_labels(passable: np.ndarray) -> np.ndarray:
    """A number for every run of passable pixels along the rows; runs of different rows differ."""
    starts = np.ones(passable.shape, bool)
    starts[:, 1:] = passable[:, 1:] != passable[:, :-1]
    return np.cumsum(starts).reshape(passable.shape)
