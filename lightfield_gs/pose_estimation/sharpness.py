"""Which pictures of a row are blurred, beside their neighbours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image

LONGEST_PX = 960  # of pictures that are compared: noise of a few pixels does not count
# A picture is blurred where its sharpness is below the upper quartile by _DEVIATIONS of the spread of sharp ones, and
# by the first of these fractions; by the second in any case. Chosen on 14 photographs of bananas and 97 of a room,
# blurred by 3 to 15 pixels of 960 in all directions, and on a smooth made-up wall
_DEVIATIONS, _LEAST_DROP, _SURE_DROP = 5.0, 0.12, 0.45
_UPPER, _TOP = 0.75, 0.95  # quantiles between which lies a standard deviation of normal values
_TINY = 1e-9  # of tensors of pictures of one colour, which have no sharpness


def small_grey(pixels: np.ndarray) -> np.ndarray:
    """Return a picture uint8 [H,W,3 or 4] as grey uint8 of LONGEST_PX at most, by means over areas."""
    image = Image.fromarray(np.ascontiguousarray(pixels[..., :3])).convert("L")
    scale = min(1.0, LONGEST_PX / max(image.size))
    size = max(1, round(scale * image.width)), max(1, round(scale * image.height))
    return np.asarray(image.resize(size, Image.Resampling.BOX))


def structure_tensor(grey: np.ndarray) -> np.ndarray:
    """Return the mean outer product of the gradients, float64 [2,2], of a picture [H,W]."""
    rows, columns = (gradient.ravel() for gradient in np.gradient(grey.astype(np.float32)))
    return np.array([[rows @ rows, rows @ columns], [rows @ columns, columns @ columns]], np.float64) / grey.size


def relative_sharpness(tensors: Sequence[np.ndarray], reach: int) -> np.ndarray:
    """Return the sharpness of the pictures of a row, [N]: about 1 for sharp ones, less for blurred ones.

    Neighbours show nearly the same. Motion takes gradients along its direction, and bad focus all. The sharpness is
    the root of the least ratio, over all directions, of a picture's gradient energy to the energy of the sharper half
    of its neighbours: the smallest eigenvalue of both structure tensors.

    Args:
        tensors: structure tensors of the pictures.
        reach: number of neighbours to either side.
    """
    return np.array(
        [_ratio(own, tensors[max(0, index - reach) : index + reach + 1]) for index, own in enumerate(tensors)]
    )


def _ratio(own: np.ndarray, neighbours: Sequence[np.ndarray]) -> float:
    by_energy = sorted(neighbours, key=np.trace)
    sharp = np.mean(by_energy[len(by_energy) // 2 :], 0) + _TINY * np.eye(2)
    return float(np.sqrt(np.linalg.eigvals(np.linalg.solve(sharp, own)).real.min().clip(0)))


def find_blurred(sharpness: np.ndarray) -> np.ndarray:
    """Return which pictures are blurred, bool [N], by their relative sharpness [N]."""
    if not len(sharpness):
        return np.zeros(0, bool)
    upper, top = np.quantile(sharpness, [_UPPER, _TOP])
    drop = float(np.clip(_DEVIATIONS * (top - upper) / max(upper, _TINY), _LEAST_DROP, _SURE_DROP))
    return sharpness < (1 - drop) * upper
