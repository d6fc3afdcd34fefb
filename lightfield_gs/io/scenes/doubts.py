"""What looks wrong in the numbers of a file of Gaussians, though each has a meaning.

Each rule looks for something that no scene fitted to photographs shows, for nobody reads notes that are often wrong.
"""

from __future__ import annotations

import math

import numpy as np

_LEAST_COUNT = 20  # Gaussians: fewer say nothing about how they were made
_SAMPLE = 4096  # Gaussians that medians are taken of
_LARGE = 0.1  # no usual Gaussian has this share of the scene's extent
_NEAR_ONE = 0.1  # a median log scale below this, and none below 0: half of the Gaussians between 1 and 1.1 scene units
_LARGEST_LOGIT = 20  # the sigmoid is 1 in float32 from 17.4 on
_NO_SIZE = 1e-37  # a size up to this one is that of a point, whose log scale is -inf
_STEP = 0.5  # centres that are rounded to steps of this share of the usual Gaussian's size tear surfaces


def usual(values: np.ndarray) -> np.ndarray | None:
    """Medians of the columns of values [N, C], from a sample of the rows; None where none of these is finite."""
    sample = values[:: max(1, len(values) // _SAMPLE)]
    sample = sample[np.isfinite(sample).all(1)]
    return np.median(sample, 0) if len(sample) else None


def usual_size(scales: np.ndarray) -> float:
    """Median of the middle standard deviations of scales [N, 3]. It is infinite for points: they have no size beside
    which anything could be large."""
    size = _middle(np.sort(scales[:: max(1, len(scales) // _SAMPLE)], 1)[:, 1:2])
    return size if size > _NO_SIZE else math.inf


def float_step(coordinates: np.ndarray) -> float:
    """Largest distance from one of these numbers to the next of float32."""
    return float(np.spacing(np.abs(coordinates).astype(np.float32)).max())


def about_values(log_scales: np.ndarray, logits: np.ndarray | None, means: np.ndarray) -> list[str]:
    """Notes on numbers as they are stored that look like the values themselves, not their log or logit. logits: None
    where the file has none."""
    if len(means) < _LEAST_COUNT:
        return []
    notes = []
    size, extent = _middle(log_scales), _extent(means)
    if (
        np.nanmin(log_scales) >= 0
        and 0 < size < extent
        and (size < _NEAR_ONE or size > np.log(max(_LARGE * extent, 1)))
    ):
        notes.append(
            f"no scale is below 0 (median {size:.3g}), which as logarithms makes every Gaussian larger than "
            f"one unit, in a scene of {extent:.3g}: they look like standard deviations themselves; export the "
            "file with their logarithms"
        )
    if logits is None:
        return notes
    low, high = np.nanmin(logits), np.nanmax(logits)
    if low >= 0 and _LARGEST_LOGIT < high <= 255 and (logits % 1 == 0).all():
        notes.append(
            f"all opacities are whole numbers within {low:.3g}..{high:.3g}, which as logits makes no Gaussian fainter "
            "than 0.5: they look like opacities of 0..255; export the file with their logits"
        )
    if low >= 0 and 0 < high <= 1:
        notes.append(
            f"all opacities are within {low:.3g}..{high:.3g}, which as logits makes no Gaussian fainter than "
            "0.5 or more opaque than 0.73: they look like opacities themselves; export the file with their "
            "logits"
        )
    return notes


def _middle(values: np.ndarray) -> float:
    """Median of the columns' medians, 0 where no row is finite."""
    medians = usual(values)
    return 0.0 if medians is None else float(np.median(medians))


def _extent(means: np.ndarray) -> float:
    """Diagonal of the box of the centres [N, 3], without the outer twentieth of them on each side."""
    sample = means[:: max(1, len(means) // _SAMPLE)]
    sample = sample[np.isfinite(sample).all(1)]
    low, high = np.percentile(sample, (5, 95), 0) if len(sample) else np.zeros((2, 3))
    return float(np.linalg.norm(high - low))


def about_steps(records: np.ndarray, scales: np.ndarray) -> list[str]:
    """A note where the centres were rounded by float32 to steps that are not small beside the Gaussians."""
    sample = np.stack([records[name][:: max(1, len(records) // _SAMPLE)] for name in "xyz"], 1)
    with np.errstate(over="ignore", invalid="ignore"):
        if not np.array_equal(sample, sample.astype(np.float32), equal_nan=True):
            return []  # more digits than float32 has
        size, far = usual_size(scales), usual(np.abs(sample).astype(np.float32))
        if len(records) < _LEAST_COUNT or far is None or float_step(far) <= _STEP * size:
            return []
    return [
        f"coordinates near {far.max():.0f} are rounded to steps of {float_step(far):.3g} (float32), and the usual "
        f"Gaussian's standard deviation is {size:.3g}: the scene is torn; export it with an offset taken off, or "
        "with x, y, z as double"
    ]
