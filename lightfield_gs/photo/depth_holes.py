"""Depths of pixels that were not measured, from those around them and the photo's colours."""

from __future__ import annotations

import numpy as np

_COLOUR_STD = 0.06  # of the weights by colour, 0..1; chosen by hand, as the next
_SAME_SURFACE = 1.1  # ratio of disparities up to which both sides of a hole are one surface, which goes on between them


def fill_holes(z: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Return a depth map whose holes are filled, float32 [H, W].

    A hole's pixel takes the depth of the nearest measured pixel to the left, right, above or below: of the one whose
    colour is most like its own, and which is close. Where both sides are one surface, it lies between them.

    Args:
        z: Distances [H, W], NaN where nothing was measured.
        photo: [H, W, 3 or more], floats in 0..1.
    """
    hole = ~np.isfinite(z)
    if not hole.any() or hole.all():
        return z
    rows, columns = hole.nonzero()
    disparity = np.where(hole, 0, 1 / np.where(hole, 1, z))
    colours = photo[..., :3]
    values, weights = [], []
    for flip in (False, True):
        known, own, other = (~hole, rows, columns) if not flip else (~hole.T, columns, rows)
        before, after = _nearest(known)
        ends = []
        for nearest in (before, after):
            at = nearest[own, other]
            place = (own, at) if not flip else (at, own)
            apart = np.square(colours[place] - colours[rows, columns]).sum(1)
            away = np.abs(at - other)
            weight = np.where(at >= 0, np.exp(-apart / (2 * _COLOUR_STD**2)) + 1e-6, 0) / np.maximum(away, 1)
            ends.append((np.where(at >= 0, disparity[place], 0), weight, away))
        (one, first, left), (two, second, right) = ends
        is_one = (np.minimum(one, two) > 0) & (np.maximum(one, two) <= _SAME_SURFACE * np.minimum(one, two))
        between = (one * right + two * left) / np.maximum(left + right, 1)
        values += [np.where(is_one, between, one), np.where(is_one, between, two)]
        weights += [first, second]
    best = np.stack(weights).argmax(0)
    chosen = np.stack(values)[best, np.arange(len(rows))]
    filled = z.copy()
    filled[rows, columns] = np.where(chosen > 0, 1 / np.maximum(chosen, 1e-30), np.nan)
    # A pixel with nothing known in its row and column: once more, from those that are filled now
    return filled if np.isfinite(filled).all() else fill_holes(filled, photo)


def _nearest(known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the column of the nearest known pixel to the left and to the right, [H, W]; -1: there is none."""
    width = known.shape[1]
    columns = np.arange(width)
    before = np.maximum.accumulate(np.where(known, columns, -1), 1)
    after = np.minimum.accumulate(np.where(known, columns, width)[:, ::-1], 1)[:, ::-1]
    return before, np.where(after < width, after, -1)
