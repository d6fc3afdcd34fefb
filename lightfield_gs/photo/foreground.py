"""Clean the edges of a cut-out: how much of each pixel is the object, and its colour without the old background's."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from lightfield_gs.photo.image_filters import row_strips


@dataclass(frozen=True)
class ForegroundConstants:
    """The estimation of foregrounds.

    `pull` and `steer` are those of Germer et al. 2020. The others are chosen by hand, on the photos of docs/photos.md;
    those of mixtures on eight of them before five plain backgrounds each, and on one that has its own.
    """

    pull: float = 5e-3  # weight of a neighbour's colours
    steer: float = 0.1  # weight in addition, per difference of alpha
    iterations: tuple[int, int] = (10, 4)  # on small levels, and on others
    small_px: int = 32  # longer side of a small level
    most_px: int = 512  # longer side of the largest level
    around_px: int = 8  # pixels of the old background around the object that are looked at
    inner_px: int = 2  # distance of the pixels from the edge that show the object's own colour
    # error of a mixture, as a fraction of the error of the object's own colour, up to which edges are a mixture
    mixed: float = 0.5
    least_pixels: int = 16  # partly transparent pixels that are enough to tell

    # Alpha as a mixture of the object's own colour and a plain background. Distances of colours, channels in 0..1
    reach_px: float = 5.0  # farthest own colour: those of thin parts are not known
    # distance from all mixtures from which on a pixel is the object's; up to the first it is a halo or a shadow
    other: tuple[float, float] = (0.2, 0.3)
    # distance of own colour and background from which on mixtures begin to count, and count alone
    apart: tuple[float, float] = (0.25, 0.4)
    certain: tuple[float, float] = (0.1, 0.9)  # shares that count as nought and as one, for noise


_C = ForegroundConstants()
_TRANSPARENT, _OPAQUE = 0.01, 0.99  # alpha up to which a pixel shows the background alone, and from which the object


def estimate_foreground(image: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the colours of the object and of the background of which each pixel is a mixture.

    The method is that of Germer et al. ("Fast multi-level foreground estimation", 2020): from coarse to fine, minimise
    |I - a F - (1 - a) B|^2 plus the differences of F and B to their neighbours, which weigh more where alpha changes.
    Only pixels that are mixtures are iterated, all at once (Jacobi).

    Args:
        image: [H, W, 3] float32, 0..1, with the old background.
        alpha: [H, W] float32, 0..1.

    Returns:
        Foreground and background, [H, W, 3] float32 each.
    """
    levels = max(1, math.ceil(math.log2(max(alpha.shape))))
    front, back = (_mean(image, mask)[None, None] for mask in (alpha > 0.9, alpha < 0.1))
    for level in range(levels + 1):
        height, width = (max(1, round(size ** (level / levels))) for size in alpha.shape)
        colours, covered = _resampled(image, height, width), _resampled(alpha, height, width)
        front = np.where((covered >= _OPAQUE)[..., None], colours, _resampled(front, height, width))
        back = np.where((covered <= _TRANSPARENT)[..., None], colours, _resampled(back, height, width))
        count = _C.iterations[max(height, width) > _C.small_px]
        _improve(colours, covered, front.reshape(-1, 3), back.reshape(-1, 3), count)
    return front, back


def _mean(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the mean colour of the pixels of a mask; of all where there is none."""
    return image[mask].mean(0) if mask.any() else image.mean((0, 1))


def _resampled(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the nearest pixels of an image at another size."""
    rows, columns = (np.arange(new) * old // new for new, old in zip((height, width), values.shape))
    return values[rows[:, None], columns[None]]


def _improve(image: np.ndarray, alpha: np.ndarray, front: np.ndarray, back: np.ndarray, count: int) -> None:
    """Iterate the mixed pixels of one level, in place.

    Args:
        image: [H, W, 3].
        alpha: [H, W].
        front: [H * W, 3], the foreground.
        back: [H * W, 3], the background.
        count: Number of iterations.
    """
    height, width = alpha.shape
    row, column = np.nonzero((alpha > _TRANSPARENT) & (alpha < _OPAQUE))
    here, flat = row * width + column, alpha.reshape(-1)
    beside = [np.clip(row + step, 0, height - 1) * width + column for step in (-1, 1)]
    beside += [row * width + np.clip(column + step, 0, width - 1) for step in (-1, 1)]
    a = flat[here][:, None]
    b = 1 - a
    weights = [_C.pull + _C.steer * np.abs(a - flat[there][:, None]) for there in beside]
    total = np.sum(weights, axis=0)
    # The inverse of the 2 x 2 matrix of each pixel
    aa, ab, bb = a * a + total, a * b, b * b + total
    determinant = aa * bb - ab * ab
    aa, ab, bb = aa / determinant, ab / determinant, bb / determinant
    mixture = image.reshape(-1, 3)[here]
    for _ in range(count):
        of_front, of_back = a * mixture, b * mixture
        for weight, there in zip(weights, beside):
            of_front += weight * front[there]
            of_back += weight * back[there]
        front[here] = (bb * of_front - ab * of_back).clip(0, 1)
        back[here] = (aa * of_back - ab * of_front).clip(0, 1)


def mix_edges(rgb: np.ndarray, alpha: np.ndarray, backdrop: np.ndarray) -> None:
    """Replace alpha near the edges of an object by its share of the mixture with a plain background, in place.

    Alpha by the distance from the background alone takes mixtures, and a dark halo, for the object.

    Args:
        rgb: [H, W, 3], uint8 or float32 in 0..1.
        alpha: [H, W] float32, 0..1.
        backdrop: [3, 3]; the background's colour at a pixel is (1, down, across) @ backdrop, down and across in -1..1.
    """
    if not (alpha >= _OPAQUE).any():
        return
    box = _object_box(alpha)
    step = _step(box)
    covered = alpha[box][::step, ::step]
    core = ndimage.binary_erosion(covered >= _OPAQUE, np.ones((3, 3)), _C.inner_px, border_value=1)
    if not core.any():
        return
    distance = ndimage.distance_transform_edt(~core)
    own = _nearest(_floats(rgb[box][::step, ::step]), core)
    edge = ~core & (distance <= _C.reach_px) & ndimage.binary_dilation(covered > 0)
    height, width = alpha[box].shape
    edge = edge.repeat(step, 0).repeat(step, 1)[:height, :width] & (alpha[box] > 0)
    down, across = (np.linspace(-1, 1, size, dtype=np.float32)[part] for size, part in zip(alpha.shape, box))
    for rows, columns in _strips(edge):
        behind = backdrop[0] + down[rows, None] * backdrop[1] + across[columns, None] * backdrop[2]
        span = own[rows // step, columns // step] - behind
        colours = _floats(rgb[box][rows, columns]) - behind
        before = alpha[box][rows, columns]
        each = torch.from_numpy(colours.T), torch.from_numpy(span.T), torch.from_numpy(before)
        alpha[box][rows, columns] = mixed_alpha(*each).numpy()


def mixed_alpha(colours: Tensor, span: Tensor, before: Tensor) -> Tensor:
    """Return the share of the object in mixtures with a plain background, where that can be told.

    Args:
        colours: [3, ...], of the pixels, less the background's.
        span: [3, ...], the object's own colour, less the background's.
        before: [...], alpha that stays where the two are too alike.
    """
    length = span.square().sum(0).sqrt()
    share = _ramp((colours * span).sum(0) / length.clamp(min=1e-3) ** 2, _C.certain)
    share = torch.maximum(share, _ramp((colours - share * span).square().sum(0).sqrt(), _C.other))
    return before + _ramp(length, _C.apart) * (share - before)


def _ramp(values: Tensor, ends: tuple[float, float]) -> Tensor:
    """Return 0 up to the first end, 1 from the second on, and linear numbers between."""
    return ((values - ends[0]) / (ends[1] - ends[0])).clip(0, 1)


def clean_edges(rgb: np.ndarray, alpha: np.ndarray, has_background: bool) -> bool:
    """Take the old background out of the colours of partly transparent pixels, in place.

    Args:
        rgb: [H, W, 3], uint8 or float32 in 0..1.
        alpha: [H, W] float32, straight alpha 0..1.
        has_background: Whether the colours are certainly mixtures, as of a photo with a mask. Otherwise the edges
            decide: they are mixtures if a background, one colour or the colours under alpha 0, explains them far better
            than the object's own colours do.

    Returns:
        Whether pixels were changed.
    """
    mixed = (alpha > 0) & (alpha < 1)
    if np.count_nonzero(mixed) < _C.least_pixels or not (alpha >= _OPAQUE).any():
        return False
    box = _object_box(alpha)
    step = _step(box)
    part, covered = _floats(rgb[box][::step, ::step]), alpha[box][::step, ::step]
    if not has_background:
        backdrop = _find_backdrop(part, covered)
        if backdrop is None:
            return False
        # Under alpha 0 the file may have any colour
        part = np.where((covered <= _TRANSPARENT)[..., None], backdrop, part)
    front, back = estimate_foreground(part, covered)
    for rows, columns in _strips(mixed[box]):
        target = rgb[box]
        near = rows // step, columns // step
        colours = front[near]
        if step > 1:  # the estimate has to explain the finer pixel
            a = alpha[box][rows, columns][:, None]
            error = _floats(target[rows, columns]) - a * colours - (1 - a) * back[near]
            colours = (colours + a * error / (a * a + (1 - a) ** 2)).clip(0, 1)
        target[rows, columns] = colours if rgb.dtype == np.float32 else np.rint(255 * colours)
    return True


def _object_box(alpha: np.ndarray) -> tuple[slice, slice]:
    """Return the box round everything that is not transparent, with some of the background."""
    (box,) = ndimage.find_objects((alpha > 0).view(np.uint8))
    around = (slice(max(0, side.start - _C.around_px), side.stop + _C.around_px) for side in box)
    rows, columns = around
    return rows, columns


def _step(box: tuple[slice, slice]) -> int:
    """Return every how many pixels an object is looked at."""
    return max(1, math.ceil(max(part.stop - part.start for part in box) / _C.most_px))


def _strips(mixed: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield rows and columns of the pixels of a mask, some at a time."""
    for top, bottom in row_strips(mixed.shape[0], mixed.shape[1], 1 << 20):
        rows, columns = np.nonzero(mixed[top:bottom])
        yield rows + top, columns


def _floats(colours: np.ndarray) -> np.ndarray:
    """Return uint8 or float32 colours as float32 in 0..1."""
    return colours.astype(np.float32) / np.float32(255 if colours.dtype == np.uint8 else 1)


def _find_backdrop(image: np.ndarray, alpha: np.ndarray) -> np.ndarray | None:
    """Return the background, [3] or [H, W, 3], that the edge's colours are mixed with; None where they are not.

    Args:
        image: [H, W, 3] float32; under alpha 0 it may have any colours.
        alpha: [H, W].
    """
    mixed = (alpha > 0.02) & (alpha < 0.98)
    if np.count_nonzero(mixed) < _C.least_pixels:
        return None
    core = ndimage.binary_erosion(alpha >= 0.98, iterations=_C.inner_px)
    if not core.any():
        return None
    own = _nearest(image, core)[mixed]
    a = alpha[mixed][:, None]
    seen, b = image[mixed], 1 - a
    rest = seen - a * own
    plain = ((rest * b).sum(0) / (b * b).sum()).clip(0, 1)
    own_error = ((seen - own) ** 2).mean()
    found: list[tuple[float, np.ndarray]] = [(float(((rest - b * plain) ** 2).mean()), plain)]
    hidden = ndimage.binary_erosion(alpha <= 0, border_value=1)
    if hidden.any():
        under = _nearest(image, hidden)
        found.append((float(((rest - b * under[mixed]) ** 2).mean()), under))
    error, backdrop = min(found, key=lambda one: one[0])
    return backdrop.astype(np.float32) if error < _C.mixed * own_error else None


def _nearest(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return for each pixel the colour of the nearest pixel of the mask, a little smoothed."""
    rows, columns = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
    return ndimage.gaussian_filter(image[rows, columns], (1.5, 1.5, 0))
