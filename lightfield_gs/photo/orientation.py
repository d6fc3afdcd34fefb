"""Maps of a photo, masks and depths, whose rows and columns may be those of the file before it was turned upright."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import MAP_ORIENTATIONS
from lightfield_gs.io.images import apply_orientation

_SAME_SHAPE = 0.03  # how far ratios of height and width may be apart: networks round sides to multiples of 14 or 32


def is_alike(shape: Sequence[int], other: Sequence[int]) -> bool:
    """Whether two sizes, height and width, are those of the same picture, reduced or not."""
    ratio = shape[0] * other[1] / (shape[1] * other[0])
    return abs(ratio - 1) <= _SAME_SHAPE


def turned_with_photo(
    name: str,
    values: np.ndarray,
    own: int,
    photo: tuple[int, int],
    orientation: int,
    choice: str | None = None,
    *,
    any_size: bool = False,
) -> tuple[np.ndarray, bool]:
    """values [H, W, ...] of a map, upright as its photo is, and whether they had to be turned.

    name: of the map's file. own: the Exif orientation that this file had itself: where it had one, or the photo had
    none, there is nothing to do. photo: height and width of the upright photo, and the Exif `orientation` by which it
    was turned. The map is turned likewise where only the size before fits it. Where both do, `choice` has to say what
    it is: "stored", as the photo's file has its pixels, or "upright". any_size: the map may be another size, of the
    same shape. Raises InputError.
    """
    if choice is not None and choice not in MAP_ORIENTATIONS:
        raise InputError(f"map orientation: expected {' or '.join(MAP_ORIENTATIONS)}, got {choice!r}")
    if orientation not in range(2, 9) or own != 1:
        return values, False
    stored = photo[::-1] if orientation >= 5 else photo
    fits = is_alike if any_size else lambda shape, size: tuple(shape) == tuple(size)
    fits_stored, fits_upright = (fits(values.shape[:2], size) for size in (stored, photo))
    if choice is None and fits_stored and fits_upright:
        raise InputError(
            f"{name}: the photo is turned by its Exif orientation {orientation}, and the map may be of "
            "either; say which with --map-orientation: stored (as the photo's file has its pixels) or "
            "upright"
        )
    turned = choice == "stored" or choice is None and fits_stored
    return apply_orientation(values, orientation) if turned else values, turned
