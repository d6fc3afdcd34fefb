"""Find the subject of a photo with depths: what stands before its surroundings, near the middle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from torch import Tensor

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class SubjectConstants:
    """Thresholds of a subject.

    All are chosen by hand and not tuned on a data set; tests/photo/test_subject_box.py has the pictures.
    """

    size_px: int = 160  # longer side of the map as it is looked at
    rounds: int = 12  # of the robust fit of a plane
    above: float = 0.4  # fraction of the pixels behind the plane: more than half of them may be the ground
    distinct: float = 0.12  # least distance of a subject from the plane, as a fraction of the range of disparities
    foot: float = 0.6  # of the threshold between ground and things, so that their feet count too
    least: float = 0.004  # least fraction of the picture
    middle: float = 0.3  # standard deviation of the weight of the middle, in sides of the picture
    beside: float = 0.25  # weight of a thing that belongs to the subject, as a fraction of the subject's
    most: float = 0.8  # fraction of the picture from which on a thing is no subject
    margin: float = 0.04  # on each side of the box, as a fraction of the longer side


_C = SubjectConstants()


def subject_box(depth: Tensor) -> Box | None:
    """Return the box (left, top, right, bottom) around the subject of a photo, with a margin, in its pixels.

    The disparity of a plane, as the ground or a wall, is linear over the picture. The subject stands before the plane
    that fits most of the picture.

    Args:
        depth: [H, W], z; not finite where it is not known.

    Returns:
        None where nothing stands out.
    """
    step = max(1, -(-max(depth.shape) // _C.size_px))
    small = depth[::step, ::step].double().cpu().numpy()
    with np.errstate(divide="ignore"):
        disparity = np.where(np.isfinite(small) & (small > 0), 1 / small, np.nan)
    if not np.isfinite(disparity).any():
        return None
    disparity = np.where(np.isfinite(disparity), disparity, np.nanmin(disparity))
    before = disparity - _fit_plane(disparity)
    low, high = np.quantile(disparity, [0.02, 0.98])
    least = _C.distinct * (high - low)
    if high - low <= 1e-6 * high or not (before > least).any():
        return None
    things, count = ndimage.label(before > max(least, _C.foot * _split(before[before > 0])))
    rows, columns = (np.arange(size) / size + 0.5 / size - 0.5 for size in small.shape)
    weight = np.exp(-(rows[:, None] ** 2 + columns**2) / (2 * _C.middle**2))
    numbers = np.arange(1, count + 1)
    areas = ndimage.sum_labels(np.ones_like(small), things, numbers) / small.size
    weights = ndimage.sum_labels(weight, things, numbers) * (areas >= _C.least)
    if not weights.any():
        return None
    subject = np.isin(things, numbers[weights >= _C.beside * weights.max()])
    if subject.mean() > _C.most:
        return None
    ((down, across),) = ndimage.find_objects(subject.view(np.uint8))
    margin = _C.margin * max(depth.shape)
    height, width = depth.shape
    return (
        max(0.0, across.start * step - margin),
        max(0.0, down.start * step - margin),
        min(float(width), across.stop * step + margin),
        min(float(height), down.stop * step + margin),
    )


def _fit_plane(values: np.ndarray) -> np.ndarray:
    """Return the plane [H, W] that a fraction `above` of the values lies below: a quantile regression."""
    rows, columns = (np.linspace(-1, 1, size) for size in values.shape)
    terms = np.stack([np.ones_like(values), rows[:, None] + 0 * values, columns + 0 * values], -1).reshape(-1, 3)
    flat = values.reshape(-1)
    plane = np.full_like(flat, np.quantile(flat, _C.above))
    least = 1e-3 * max(float(np.ptp(flat)), 1e-12)
    for _ in range(_C.rounds):
        off = flat - plane
        weights = np.where(off > 0, _C.above, 1 - _C.above) / np.maximum(np.abs(off), least)
        weighted = terms * weights[:, None]
        plane = terms @ np.linalg.lstsq(weighted.T @ terms, weighted.T @ flat, rcond=None)[0]
    return plane.reshape(values.shape)


def _split(values: np.ndarray) -> float:
    """Return the threshold between two groups of values [M], by Otsu's method."""
    counts, edges = np.histogram(values, 128)
    middles = (edges[:-1] + edges[1:]) / 2
    below = counts.cumsum()[:-1]
    above = below[-1] + counts[-1] - below
    sums = (counts * middles).cumsum()
    with np.errstate(divide="ignore", invalid="ignore"):
        between = below * above * (sums[:-1] / below - (sums[-1] - sums[:-1]) / above) ** 2
    return float(edges[1:-1][np.nan_to_num(between).argmax()])
