"""Objects cut out from a plain background, by colour and connected components; and whether to trust the cut-out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from lightfield_gs.photo.foreground import mix_edges
from lightfield_gs.photo.image_filters import row_strips

# Memory
_MOST_PIXELS = 1 << 24  # larger photos are cut out by the means of blocks: a display shows no more pixels
_STRIP_PIXELS = 1 << 19  # in floating point at a time: eight bytes times all pixels would be more than a photo itself


@dataclass(frozen=True)
class PlainPhotoConstants:
    """Thresholds of the cut-out. Distances of colours are Euclidean, channels in 0..1.

    Unless a comment says otherwise, they are chosen by hand and not tuned on a data set. tests/photo/test_photos.py has
    pictures that they must tell apart.
    """

    # The border, which has to be plain
    border_fraction: float = 0.02  # width of the border by the image's shorter side, at least one pixel
    plain_std: float = 0.04  # largest standard deviation of the border's colour, without outliers
    plain_fraction: float = 0.9  # least fraction of the border's pixels that are near the background's colour
    band_lines: int = 16  # lines of a band of the border that are read, at least; twice as many at most
    least_slope: float = 0.02  # least change of the background's colour from middle to edge that counts as a gradient
    fit_quantile: float = 0.995  # quantile of the border's distances from its fitted colour, for `least_difference`
    fit_margin: float = 1.2  # factor of this quantile from which on a colour differs

    # The mask
    near: float = 0.06  # colour distance up to which alpha is 0
    far: float = 0.14  # colour distance from which on alpha is 1
    same: float = 0.02  # colour distance up to which an enclosed patch may be the background, seen through a hole
    hole_side: float = 0.025  # side of a square in a hole, by the image's shorter side; less: a highlight

    # Noise
    windows_px: tuple[int, ...] = (1, 3, 5, 7, 9)  # sides of the squares of means, the first that calms the noise
    noise_quantile: float = 0.98  # fraction of the border's differences that count as noise: the rest are specks
    noise_factor: float = 5.0  # standard deviations of noise that must stay within `near`
    noise_reach: float = 3.4  # standard deviations per channel that a colour exceeds by chance once in a hundred times

    # Loss: parts of an object that hardly differ from the background
    least_difference: float = 0.012  # colour distance below which a pixel is of a background without noise
    edge_px: int = 3  # distance inside an edge at which a body, unlike a shadow, differs clearly
    clearly: float = 2.0  # factor of the least difference that is clear
    sharp_fraction: float = 0.5  # fraction of an edge's length on which it differs clearly
    block_px: int = 16  # distance from a strong edge within which JPEG makes up colours: the side of its blocks
    loss_samples: int = 1500  # pixels of the longer side that are read to measure loss

    # Components of an object, by mass, the sum of alpha, as a fraction of the largest component's
    dust_mass: float = 1e-4  # a smaller component is never part of the object
    bead_mass: float = 0.001  # a larger one is, if it is near: within `bead_reach` times the root of its mass
    bead_reach: float = 2.0
    most_beads: int = 64  # more candidates than these are noise
    part_mass: float = 0.03  # a larger component is part of the object wherever it is


_C = PlainPhotoConstants()


class Components:
    """Connected components of a mask.

    Attributes:
        labels: int32 [H, W], 0 outside the mask, 1..count within it.
        count: Number of components.
    """

    def __init__(self, mask: np.ndarray, diagonal: bool):
        """Label the components of a mask, bool [H, W]; diagonal: whether pixels that share a corner are neighbours."""
        self.labels, self.count = ndimage.label(mask, np.ones((3, 3)) if diagonal else None)

    def touching(self, mask: np.ndarray) -> np.ndarray:
        """Return which components, bool [count], have a pixel in the mask, bool [H, W]."""
        found = np.zeros(self.count + 1, bool)
        found[self.labels[mask]] = True
        return found[1:]

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sum of values [H, W] over each component, float64 [count]."""
        sums = np.zeros(self.count + 1)
        for top, bottom in row_strips(values.shape[0], values.shape[1], _STRIP_PIXELS):
            labels, weights = self.labels[top:bottom].ravel(), values[top:bottom].ravel()
            sums += np.bincount(labels, weights, self.count + 1)
        return sums[1:]

    def boxes(self) -> np.ndarray:
        """Return top, left, bottom and right of each component, [count, 4]; bottom and right are exclusive."""
        slices = ndimage.find_objects(self.labels)
        boxes = [(rows.start, columns.start, rows.stop, columns.stop) for rows, columns in slices]
        return np.array(boxes, int).reshape(-1, 4)

    def mask(self, chosen: np.ndarray) -> np.ndarray:
        """Return the pixels, bool [H, W], of the components in chosen, bool [count]."""
        return np.concatenate([[False], chosen])[self.labels]


def object_components(alpha: np.ndarray, opaque: float) -> tuple[np.ndarray, int, int]:
    """Part an object from the specks beside it.

    A component of 3 % of the largest mass or more belongs to the object. A component of 0.1 % counts if it is near
    another one for its size: beads are, dust is not. A smaller one does within the box of all these, down to 0.01 %.

    Args:
        alpha: float32 [H, W], 0..1.
        opaque: Alpha from which on a pixel belongs to a component.

    Returns:
        The mask of the object, bool [H, W], the number of its components, and the number of specks.
    """
    components = Components(alpha >= opaque, diagonal=True)
    masses = components.sums(alpha)
    relative = masses / masses.max(initial=1e-300)
    boxes, kept = components.boxes(), relative >= _C.part_mass
    beads = np.flatnonzero(~kept & (relative >= _C.bead_mass))
    if len(beads) <= _C.most_beads:
        kept[_near(beads, boxes, np.flatnonzero(kept), _C.bead_reach * np.sqrt(masses))] = True
    if kept.any():
        (top, left), (bottom, right) = boxes[kept, :2].min(0), boxes[kept, 2:].max(0)
        inside = (boxes[:, :2] >= (top, left)).all(1) & (boxes[:, 2:] <= (bottom, right)).all(1)
        kept |= inside & (relative >= _C.dust_mass)
    return components.mask(kept), int(kept.sum()), int((~kept).sum())


def _near(candidates: np.ndarray, boxes: np.ndarray, others: np.ndarray, reaches: np.ndarray) -> np.ndarray:
    """Return the candidates whose box is within reach of another component, or of a candidate found before."""
    found = []
    while len(others) and len(candidates):
        one, other = boxes[candidates][:, None], boxes[others][None]
        gaps = np.maximum(other[..., :2] - one[..., 2:], one[..., :2] - other[..., 2:]).max(2).min(1)
        near = gaps <= reaches[candidates]
        found += [others := candidates[near]]
        candidates = candidates[~near]
    return np.concatenate(found) if found else candidates[:0]


@dataclass(frozen=True)
class PlainCut:
    """An object cut out from a plain background.

    Attributes:
        alpha: float32 [H, W] in 0..1, 1 on the object.
        faded: Fraction 0..1 of the object and its gaps that was cut off although its colour differs, as of a pale body.
        holes: Fraction of the same area through which the background shows.
    """

    alpha: np.ndarray
    faded: float
    holes: float


def plain_background_mask(rgb: np.ndarray) -> np.ndarray | None:
    """Return alpha [H, W] of the object on the plain background of `rgb` [H, W, 3]; None if it is not plain."""
    cut = cut_from_plain_background(rgb)
    return None if cut is None else cut.alpha


def cut_from_plain_background(rgb: np.ndarray) -> PlainCut | None:
    """Cut the object out of a photo with a plain background.

    The background has about the border's colour. It is connected to the border. A patch inside the object counts too if
    it has exactly this colour and is as large as a hole, as in a handle. Smaller spots stay opaque. The edge is soft:
    alpha is the object's share of the mixture with the background. Where the border is noisy, colours are means over a
    few pixels. Photos of more than 16 megapixels are cut out by the means of blocks of 2 x 2 pixels and more.

    Args:
        rgb: [H, W, 3], uint8 or floats in 0..1.

    Returns:
        The cut-out; None where the background is not plain.
    """
    height, width = rgb.shape[:2]
    if height * width > _MOST_PIXELS:
        factor = math.ceil(math.sqrt(height * width / _MOST_PIXELS))
        cut = cut_from_plain_background(_block_means(rgb, factor))
        return None if cut is None else replace(cut, alpha=_enlarge(cut.alpha, factor, height, width))
    found = _parted(rgb)
    if found is None:
        return None
    background, distance, outside, holes = found
    lost = _measure_loss(outside, holes, distance, background.differs)
    alpha = alpha_of_distance(torch.from_numpy(distance)).numpy()
    alpha[~outside] = 1
    mix_edges(rgb, alpha, background.colours)
    return PlainCut(alpha, *lost)


def alpha_of_distance(distance: Tensor) -> Tensor:
    """Return alpha of pixels by their colour distance from the background, which is changed."""
    return distance.sub_(_C.near).div_(_C.far - _C.near).clamp_(0, 1)


def plain_outline(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return what is not the plain background of rgb [H, W, 3], and the background; None where it is not plain.

    Returns:
        bool [H, W], without specks beside the object; and `PlainBackground.colours`.
    """
    found = _parted(rgb)
    if found is None:
        return None
    background, _, outside, _ = found
    return object_components((~outside).astype(np.float32), 1)[0], background.colours


def _parted(rgb: np.ndarray) -> tuple[PlainBackground, np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the background, each pixel's colour distance from it, where it is, and its holes in the object."""
    if min(rgb.shape[:2]) < 8:
        return None
    background = _fit_background(rgb)
    if background is None:
        return None
    window = background.window
    distance = _distances(rgb, background.colours, window)
    outside, holes = _find_background(distance)
    if window > 1:
        raw = _distances(rgb, background.colours, 1)
        raw -= max(0.0, _C.noise_reach * background.noise - _C.near)
        # The fringe round the object, where means took in some of its colour, is background
        outside |= _dilate(outside, window // 2) & (raw < _C.far)
        np.minimum(distance, raw, out=distance)
    return background, distance, outside, holes


@dataclass(frozen=True)
class PlainBackground:
    """A plain background, whose colour may change evenly over the photo.

    Attributes:
        colours: [3, 3] float32; the colour at a pixel is (1, down, across) @ colours, down and across in -1..1.
        noise: Standard deviation of noise in a channel.
        window: Side in pixels of the squares of means that calm the noise.
        differs: Colour distance from which on such a mean is of another colour.
    """

    colours: np.ndarray
    noise: float
    window: int
    differs: float


def _fit_background(rgb: np.ndarray) -> PlainBackground | None:
    """Return the background of rgb [H, W, 3], from its border; None where the border is not plain."""
    height, width = rgb.shape[:2]
    thick = max(1, round(_C.border_fraction * min(height, width)))
    bands = _border(rgb, thick)
    noise = _noise(bands)
    window = _window_px(noise)
    border = np.concatenate([_means(band, window).reshape(-1, 3) for band in bands])
    near = np.linalg.norm(border - np.median(border, 0), axis=1) < _C.near + _C.plain_std
    if near.mean() < _C.plain_fraction or border[near].std(0).max() > _C.plain_std:
        return None
    positions = _border_positions(height, width, thick)[near]
    colours = _fit_colours(border[near], positions)
    usual = float(np.quantile(np.linalg.norm(border[near] - positions @ colours, axis=1), _C.fit_quantile))
    return PlainBackground(colours, noise, window, max(_C.least_difference, _C.fit_margin * usual))


def _block_means(rgb: np.ndarray, factor: int) -> np.ndarray:
    """Return rgb [H, W, 3] reduced by a whole factor, of the same type; odd pixels at the far edges are dropped."""
    height, width = (size // factor for size in rgb.shape[:2])
    means = np.empty((height, width, 3), rgb.dtype)
    for top, bottom in row_strips(height, width, _STRIP_PIXELS):
        block = rgb[top * factor : bottom * factor, : width * factor]
        offsets = np.ndindex(factor, factor)
        parts = (block[down::factor, across::factor].astype(np.float32) for down, across in offsets)
        total = reduce(np.add, parts) * np.float32(1 / factor**2)
        means[top:bottom] = total if rgb.dtype == np.float32 else np.rint(total)
    return means


def _enlarge(alpha: np.ndarray, factor: int, height: int, width: int) -> np.ndarray:
    """Return the alpha of a picture that _block_means reduced at the size of the picture, [height, width]."""
    each = ((height, alpha.shape[0]), (width, alpha.shape[1]))
    return alpha[np.ix_(*(np.minimum(np.arange(size) // factor, small - 1) for size, small in each))]


def _border(rgb: np.ndarray, thick: int) -> list[np.ndarray]:
    """Return the bands [lines, pixels, 3] along the four edges, float32 in 0..1; of thick bands only some lines."""
    each = max(1, thick // _C.band_lines)
    middle = rgb[thick:-thick]
    bands = (rgb[:thick], rgb[-thick:], middle[:, :thick].swapaxes(0, 1), middle[:, -thick:].swapaxes(0, 1))
    return [_floats(band[::each]) for band in bands]


def _border_positions(height: int, width: int, thick: int) -> np.ndarray:
    """Return (1, down, across) of each pixel of _border, down and across in -1..1 from edge to edge: float32 [N, 3]."""
    down, across = (np.linspace(-1, 1, size, dtype=np.float32) for size in (height, width))
    grids = (np.broadcast_to(values, (height, width))[..., None] for values in (np.float32(1), down[:, None], across))
    return np.stack([np.concatenate([band.ravel() for band in _border(grid, thick)]) for grid in grids], 1)


def _fit_colours(colours: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return PlainBackground.colours of pixels [N, 3] at their positions [N, 3].

    They have a slope only where it is clear, as on a wall that is lit from the side.
    """
    sloping = np.linalg.lstsq(positions.astype(np.float64), colours.astype(np.float64), rcond=None)[0]
    sloping = sloping.astype(np.float32)
    level = np.array([colours.mean(0), (0, 0, 0), (0, 0, 0)], np.float32)
    return sloping if np.abs(sloping[1:]).max() > _C.least_slope else level


def _floats(rgb: np.ndarray) -> np.ndarray:
    """Return colours as float32 in 0..1."""
    return rgb.astype(np.float32) * np.float32(1 / 255) if rgb.dtype == np.uint8 else rgb.astype(np.float32)


def _noise(bands: list[np.ndarray]) -> float:
    """Return the standard deviation of noise per channel, without slow gradients.

    It is measured between pixels two apart, because JPEG shares colours among neighbours.
    """
    squares = np.concatenate([(band[:, 2:] - band[:, :-2]).reshape(-1, 3) for band in bands]) ** 2 / 2
    usual = np.sort(squares, 0)[: max(1, round(_C.noise_quantile * len(squares)))]
    return float(np.sqrt(usual.mean()))


def _window_px(noise: float) -> int:
    """Return the side of the squares of means that keep noise well below the colour distances that count."""
    enough = (window for window in _C.windows_px if _C.noise_factor * noise / max(1, window - 1) <= _C.near)
    return next(enough, _C.windows_px[-1])


def _means(values: np.ndarray, window: int) -> np.ndarray:
    """Return means of values [H, W, C] over window x window pixels; beyond the edges the last pixel is repeated."""
    return values if window == 1 else ndimage.uniform_filter(values, (window, window, 1), mode="nearest")


def _distances(rgb: np.ndarray, background: np.ndarray, window: int) -> np.ndarray:
    """Return the colour distance of each pixel from the background, float32 [H, W].

    Args:
        rgb: [H, W, 3], uint8 or floats in 0..1.
        background: PlainBackground.colours.
        window: Side in pixels of the square whose mean colour counts.
    """
    (height, width), reach = rgb.shape[:2], window // 2
    distances = np.empty((height, width), np.float32)
    tables = (_floats(np.arange(256, dtype=np.uint8))[:, None] - background[0]).T ** 2
    down, across = (np.linspace(-1, 1, size, dtype=np.float32)[:, None] for size in (height, width))
    for top, bottom in row_strips(height, width, _STRIP_PIXELS):
        if window == 1 and rgb.dtype == np.uint8 and not background[1:].any():
            squares = (tables[channel][rgb[top:bottom, :, channel]] for channel in range(3))
        else:
            first = max(0, top - reach)
            block = _floats(rgb[first : bottom + reach]) - (background[0] + across * background[2])
            block -= (down[first : bottom + reach] * background[1])[:, None]
            block = _means(block, window)[top - first :][: bottom - top]
            squares = (block[..., channel] ** 2 for channel in range(3))
        np.sqrt(sum(squares), out=distances[top:bottom])
    return distances


def _find_background(distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the background, bool [H, W], and its holes in the object, which are not connected to the border."""
    height, width = distance.shape
    thick = max(1, round(_C.border_fraction * min(height, width)))
    border = np.pad(np.zeros((height - 2 * thick, width - 2 * thick), bool), thick, constant_values=True)
    side = max(3, round(_C.hole_side * min(height, width)))
    components = Components(distance < _C.far, diagonal=False)
    from_border = components.touching(border)
    from_patch = components.touching(find_full_squares(distance < _C.same, side))
    return components.mask(from_border | from_patch), components.mask(from_patch & ~from_border)


def find_full_squares(mask: np.ndarray, side: int) -> np.ndarray:
    """Return the pixels, bool [H, W], about which a square of `side` pixels lies wholly in the mask."""
    return ndimage.minimum_filter(mask, side, mode="constant")


def _dilate(mask: np.ndarray, reach: int) -> np.ndarray:
    """Return the pixels within `reach` pixels of the mask, bool [H, W], along both axes."""
    return ndimage.maximum_filter(mask, 2 * reach + 1, mode="constant")


def _measure_loss(outside: np.ndarray, holes: np.ndarray, distance: np.ndarray, differs: float) -> tuple[float, float]:
    """Return PlainCut.faded and PlainCut.holes.

    A white body before white is lost, except perhaps its outline: its shades then count as faded, the rest as holes.

    Args:
        outside: The background, bool [H, W].
        holes: Its holes in the object, bool [H, W].
        distance: Colour distance from the background, [H, W].
        differs: Distance from which on a pixel has another colour than the background.
    """
    step = max(1, round(max(distance.shape) / _C.loss_samples))
    outside, holes, distance = (values[::step, ::step] for values in (outside, holes, distance))
    opaque = (distance > (_C.near + _C.far) / 2) | ~outside
    other = distance > differs
    object_ = object_components(opaque.astype(np.float32), 1)[0]
    other &= object_ | ~opaque  # leaves out specks
    opaque = object_
    between = (_between(opaque, 0) | _between(opaque, 1)) & ~opaque
    bodies = _with_sharp_edges(other & ~opaque, other, distance, differs)
    bodies &= ~_dilate(opaque, round(_C.block_px / step))
    faded = other & ~opaque & (between | bodies)
    seen_through = between & holes & ~other
    kept, gone, hollow = (int(np.count_nonzero(pixels)) for pixels in (opaque, faded, seen_through))
    enclosed = max(1, kept + gone + hollow)
    return gone / enclosed, hollow / enclosed


def _with_sharp_edges(pale: np.ndarray, other: np.ndarray, distance: np.ndarray, differs: float) -> np.ndarray:
    """Return the components of `pale` with the edges of a body, not of a soft shadow, bool [H, W].

    A few pixels inside its edge a body differs clearly from the background.

    Args:
        pale: Pixels that hardly differ from the background, bool [H, W].
        other: All pixels of another colour, bool [H, W].
        distance: Colour distance from the background, [H, W].
        differs: Distance from which on a pixel has another colour than the background.
    """
    depth = ndimage.distance_transform_cdt(np.pad(other, 1), "taxicab")[1:-1, 1:-1]
    ring = pale & (depth == _C.edge_px)
    components = Components(pale, diagonal=True)
    sharp = components.sums((ring & (distance > _C.clearly * differs)).astype(np.float32))
    return components.mask(sharp > _C.sharp_fraction * np.maximum(1, components.sums(ring.astype(np.float32))))


def _between(mask: np.ndarray, axis: int) -> np.ndarray:
    """Return the pixels that have the mask on both sides along the axis, or on them."""
    forwards = np.maximum.accumulate(mask, axis)
    return forwards & np.flip(np.maximum.accumulate(np.flip(mask, axis), axis), axis)
