"""Whether a picture is a stereo pair: what two eyes see, side by side or one above the other."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from lightfield_gs.io.images import as_floats

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
