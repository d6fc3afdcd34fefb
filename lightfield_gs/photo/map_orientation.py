"""Masks and depth maps that are turned as their photo is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import MAP_ORIENTATIONS
from lightfield_gs.io.images import apply_orientation

# Relative difference of aspect ratios of one picture, chosen by hand: networks round sides to multiples of 14 or 32
_SAME_SHAPE = 0.03


def has_same_shape(shape: Sequence[int], other: Sequence[int]) -> bool:
    """Return whether two sizes, height and width, fit the same picture, reduced or not."""
    ratio = shape[0] * other[1] / (shape[1] * other[0])
    return abs(ratio - 1) <= _SAME_SHAPE


def turn_with_photo(
    name: str,
    values: np.ndarray,
    own_orientation: int,
    photo: tuple[int, int],
    orientation: int,
    choice: str | None = None,
    *,
    any_size: bool = False,
) -> tuple[np.ndarray, bool]:
    """Return the values of a map, upright as its photo is, and whether they had to be turned.

    The map is turned like the photo only where just the size before fits it. Where both sizes fit, `choice` decides.

    Args:
        name: Name of the map's file.
        values: [H, W, ...].
        own_orientation: The Exif orientation of the map's file: with one, or a photo without one, nothing is turned.
        photo: Height and width of the upright photo.
        orientation: The Exif orientation by which the photo was turned.
        choice: "stored", as the photo's file has its pixels, or "upright"; None: not known.
        any_size: Whether the map may have another size of the same shape.

    Raises:
        InputError: The choice is invalid, or needed and missing.
    """
    if choice is not None and choice not in MAP_ORIENTATIONS:
        raise InputError(f"map orientation: expected {' or '.join(MAP_ORIENTATIONS)}, got {choice!r}")
    if orientation not in range(2, 9) or own_orientation != 1:
        return values, False
    stored = photo[::-1] if orientation >= 5 else photo
    fits = has_same_shape if any_size else lambda shape, size: tuple(shape) == tuple(size)
    fits_stored, fits_upright = (fits(values.shape[:2], size) for size in (stored, photo))
    if choice is None and fits_stored and fits_upright:
        raise InputError(
            f"{name}: the photo is turned by its Exif orientation {orientation}, and the map may be of "
            "either; say which with map_orientation=: stored (as the photo's file has its pixels) or "
            "upright"
        )
    turned = choice == "stored" or choice is None and fits_stored
    return apply_orientation(values, orientation) if turned else values, turned
