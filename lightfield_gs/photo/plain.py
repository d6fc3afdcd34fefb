"""Objects cut out from a plain background, by colour and connected components; and whether to trust the cut-out."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from lightfield_gs.photo.image_filters import strips

# Which pieces belong to the object, by their mass as a share of the largest piece's
_DUST_SHARE = 1e-4  # a smaller piece never does
_BEAD_SHARE, _NEAR_SIZES = 0.001, 2  # from here on one does that is near: within twice its size, the root of its mass
_MOST_BEADS = 64  # if there are more of these, they are noise
_PIECE_SHARE = 0.03  # from here on a piece does wherever it is


@dataclass(frozen=True)
class Pieces:
    """The runs of set pixels of a mask, row by row, and the connected piece that each belongs to.

    rows, starts, ends: [R] int64; a run covers the columns starts .. ends - 1. labels: [R] int64 in 0..count - 1.
    """

    shape: tuple[int, int]
    rows: np.ndarray
    starts: np.ndarray
    ends: np.ndarray
    labels: np.ndarray
    count: int

    @classmethod
    def of(cls, flags: np.ndarray, diagonal: bool) -> Pieces:
        """The pieces of flags [H, W]; diagonal: whether pixels that share only a corner are neighbours."""
        rows, starts, ends = _runs(flags)
        one, other = _touching(rows, starts, ends, int(diagonal))
        labels = _joined(len(rows), one, other)
        names, labels = np.unique(labels, return_inverse=True)
        return cls(flags.shape, rows, starts, ends, labels, len(names))

    def hit(self, flags: np.ndarray) -> np.ndarray:
        """Which pieces [count] have a pixel that is set in flags [H, W]."""
        found = np.zeros(self.count, bool)
        found[self.labels[self._reduced(np.maximum, flags.view(np.uint8)) > 0]] = True
        return found

    def masses(self, values: np.ndarray) -> np.ndarray:
        """The sums [count] of values [H, W] over each piece."""
        return np.bincount(self.labels, self._reduced(np.add, values), self.count)

    def boxes(self) -> np.ndarray:
        """Top, left, bottom and right of each piece, [count, 4]; the last two are exclusive."""
        boxes = np.tile([self.shape[0], self.shape[1], 0, 0], (self.count, 1))
        for column, least in enumerate((self.rows, self.starts)):
            np.minimum.at(boxes[:, column], self.labels, least)
        for column, most in enumerate((self.rows + 1, self.ends)):
            np.maximum.at(boxes[:, 2 + column], self.labels, most)
        return boxes

    def mask(self, chosen: np.ndarray) -> np.ndarray:
        """The pixels [H, W] of the pieces that are set in chosen [count]."""
        width = self.shape[1]
        runs = chosen[self.labels]
        steps = np.zeros(self.shape[0] * width + 1, np.int8)
        np.add.at(steps, self.rows[runs] * width + self.starts[runs], 1)  # a run may begin where another ends
        np.add.at(steps, self.rows[runs] * width + self.ends[runs], -1)
        return np.cumsum(steps[:-1], dtype=np.int8).view(bool).reshape(self.shape)

    def _reduced(self, operation: np.ufunc, values: np.ndarray) -> np.ndarray:
        """Sums, or whatever the operation gives, of values [H, W] over each run."""
        if not len(self.rows):
            return np.zeros(0, values.dtype)
        edges = np.stack([self.rows * self.shape[1] + self.starts, self.rows * self.shape[1] + self.ends], 1).ravel()
        if edges[-1] == values.size:  # the last run ends with the image, to whose end reduceat goes on by itself
            edges = edges[:-1]
        return operation.reduceat(values.ravel(), edges)[::2]


def object_pieces(alpha: np.ndarray, opaque: float) -> tuple[np.ndarray, int, int]:
    """The mask [H, W] of what belongs to the object of alpha [H, W], bool, and not to specks beside it; how many pieces
    it has, and how many specks there are.

    Pieces consist of pixels of at least `opaque`; the mass of one is the sum of its alpha. Those of 3 % of the largest
    mass stay wherever they are; those of 0.1 % where they lie near to another for their size, as beads do and dust does
    not; smaller ones within the box of all these. Those below 0.01 % go in any case.
    """
    pieces = Pieces.of(alpha >= opaque, diagonal=True)
    masses = pieces.masses(alpha)
    share = masses / masses.max(initial=1e-300)
    boxes, kept = pieces.boxes(), share >= _PIECE_SHARE
    beads = np.flatnonzero(~kept & (share >= _BEAD_SHARE))
    if len(beads) <= _MOST_BEADS:
        kept[_near(beads, boxes, np.flatnonzero(kept), _NEAR_SIZES * np.sqrt(masses))] = True
    if kept.any():
        (top, left), (bottom, right) = boxes[kept, :2].min(0), boxes[kept, 2:].max(0)
        inside = (boxes[:, :2] >= (top, left)).all(1) & (boxes[:, 2:] <= (bottom, right)).all(1)
        kept |= inside & (share >= _DUST_SHARE)
    return pieces.mask(kept), int(kept.sum()), int((~kept).sum())


def _near(candidates: np.ndarray, boxes: np.ndarray, others: np.ndarray, reaches: np.ndarray) -> np.ndarray:
    """Which of the pieces `candidates` are near: their box is within their reach of the box of one of the `others`, or
    of a candidate that was found near before."""
    found = []
    while len(others) and len(candidates):
        one, other = boxes[candidates][:, None], boxes[others][None]
        gaps = np.maximum(other[..., :2] - one[..., 2:], one[..., :2] - other[..., 2:]).max(2).min(1)
        near = gaps <= reaches[candidates]
        found += [others := candidates[near]]
        candidates = candidates[~near]
    return np.concatenate(found) if found else candidates[:0]


def _runs(flags: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, first column and one more than the last column of every run of set pixels."""
    height, width = flags.shape
    padded = np.zeros((height, width + 1), bool)  # one more column, never set, keeps the runs of two rows apart
    padded[:, :width] = flags
    flat = padded.ravel()
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    if flat.size and flat[0]:
        changes = np.concatenate([[0], changes])
    starts, ends = changes[::2], changes[1::2]
    rows = starts // (width + 1)
    return rows, starts - rows * (width + 1), ends - rows * (width + 1)


def _touching(rows: np.ndarray, starts: np.ndarray, ends: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of runs that touch, the second in the row below the first; reach: 1 if corners are enough, else 0."""
    stride = 2 * (int(ends.max(initial=0)) + 2)
    # The runs of the next row are in order of their starts and of their ends, so those that touch a run follow each
    # other: a range.
    below = (rows + 1) * stride
    first = np.searchsorted(rows * stride + ends, below + starts - reach, side="right")
    last = np.searchsorted(rows * stride + starts, below + ends + reach, side="left")
    counts = np.maximum(last - first, 0)
    upper = np.repeat(np.arange(len(rows)), counts)
    offsets = np.arange(len(upper)) - np.repeat(np.cumsum(counts) - counts, counts)
    return upper, first[upper] + offsets


def _joined(count: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """A number for each of `count` things, which things that pairs join share: the least index among them."""
    roots = np.arange(count)
    while len(one):
        low, high = np.minimum(roots[one], roots[other]), np.maximum(roots[one], roots[other])
        apart = low != high
        one, other, low, high = one[apart], other[apart], low[apart], high[apart]
        np.minimum.at(roots, high, low)
        while not np.array_equal(roots, shorter := roots[roots]):
            roots = shorter
    return roots


# The border, which has to be plain. Distances of colours are Euclidean, of channels in 0..1.
_BORDER_SHARE = 0.02  # its width as a share of the shorter side, at least one pixel
_PLAIN_STD = 0.04  # largest spread of its colour, but for outliers
_PLAIN_SHARE = 0.9  # share of its pixels that must be near the background's colour
_BAND_LINES = 16  # of its lines, so many are looked at, and at most twice as many
_LEAST_SLOPE = 0.02  # least change of a background's colour, from the middle to an edge, that is taken for one

# The mask
_NEAR, _FAR = 0.06, 0.14  # colour distances between which it rises from 0 to 1
# An enclosed patch is the background, seen through a hole, if its colour is as close as _SAME and a square of
# _PATCH_SHARE of the shorter side fits in it. Smaller ones are highlights.
_SAME, _PATCH_SHARE = 0.02, 0.025

# Noise
_WINDOWS_PX = (1, 3, 5, 7, 9)  # sides of the squares over which means are taken where noise is too strong
_USUAL_SHARE = 0.98  # share of the border that has nothing but noise
_NOISE_REACH = 3.4  # deviations of noise in a channel that a colour exceeds by chance once in a hundred times

# What is lost: parts of an object that hardly differ from the background
_LEAST_DIFFERENCE = 0.012  # what differs by a smaller colour distance from a background without noise is part of it
# An edge is that of a body, and not of a shadow, if _EDGE_PX inside it colours differ _CLEARLY times as much as they
# have to, on _SHARP_SHARE of its length.
_EDGE_PX, _CLEARLY, _SHARP_SHARE = 3, 2.0, 0.5
_BLOCK_PX = 16  # how far from a strong edge JPEG makes up colours
_SHARE_SAMPLES = 1500  # pixels along the longer side that are looked at

# Memory
_MOST_PIXELS = 1 << 24  # of a photo whose pixels are looked at one by one: a display shows no more
_STRIP_PIXELS = 1 << 19  # in floating point at a time: eight bytes times all pixels would be more than a photo itself


@dataclass(frozen=True)
class PlainCut:
    """An object cut out from a plain background.

    alpha: float32 [H, W] in 0..1, 1 on the object. faded, holes: shares 0..1 of the object and what lies between its
    parts: what went with the background although its colour is another, as a pale body does, and where the background
    shows through.
    """

    alpha: np.ndarray
    faded: float
    holes: float


def plain_background_mask(rgb: np.ndarray) -> np.ndarray | None:
    """Alpha [H, W] of what stands out from the plain background of `rgb` [H, W, 3], or None where it is not plain."""
    cut = cut_from_plain_background(rgb)
    return None if cut is None else cut.alpha


def cut_from_plain_background(rgb: np.ndarray) -> PlainCut | None:
    """What stands out from the plain background of rgb [H, W, 3], uint8 or floats in 0..1; None where it is not plain.

    The background is what is near the border's colour and connected to the border, or to a patch of just that colour
    that is large enough to be a hole of the object (a handle); smaller spots inside the object stay opaque. The edge is
    soft, rising with the distance in colour. Where the border is noisy, colours are means over a few pixels. Photos of
    more than 16 megapixels are cut out by the means of blocks, of 2 x 2 pixels and more.
    """
    height, width = rgb.shape[:2]
    if height * width > _MOST_PIXELS:
        factor = math.ceil(math.sqrt(height * width / _MOST_PIXELS))
        cut = cut_from_plain_background(_block_means(rgb, factor))
        return None if cut is None else replace(cut, alpha=_enlarged(cut.alpha, factor, height, width))
    if min(height, width) < 8:
        return None
    ground = _ground_of(rgb)
    if ground is None:
        return None
    distance = _distances(rgb, ground.colours, ground.window)
    outside, holes = _background(distance)
    if ground.window > 1:
        raw = _distances(rgb, ground.colours, 1)
        raw -= max(0.0, _NOISE_REACH * ground.noise - _NEAR)
        outside, distance = _sharpened(outside, distance, raw, ground.window // 2)
    shares = _shares_lost(outside, holes, distance, ground.differs)
    distance -= _NEAR
    distance /= _FAR - _NEAR
    alpha = np.clip(distance, 0, 1, out=distance)
    alpha[~outside] = 1
    return PlainCut(alpha, *shares)


@dataclass(frozen=True)
class _Ground:
    """A plain background, whose colour may change evenly over the photo.

    colours: [3, 3] float32; its colour at a pixel is (1, down, across) @ colours, the place in -1..1 from edge to edge.
    noise: its standard deviation in a channel. window: side in pixels of the squares over which means make little of
    the noise. differs: the colour distance from which on such a mean is of another colour.
    """

    colours: np.ndarray
    noise: float
    window: int
    differs: float


def _ground_of(rgb: np.ndarray) -> _Ground | None:
    """The background of rgb [H, W, 3], from its border; None where that is not plain."""
    height, width = rgb.shape[:2]
    thick = max(1, round(_BORDER_SHARE * min(height, width)))
    bands = _border(rgb, thick)
    noise = _noise(bands)
    window = _window_px(noise)
    border = np.concatenate([_means(band, window).reshape(-1, 3) for band in bands])
    near = np.linalg.norm(border - np.median(border, 0), axis=1) < _NEAR + _PLAIN_STD
    if near.mean() < _PLAIN_SHARE or border[near].std(0).max() > _PLAIN_STD:
        return None
    places = _places(height, width, thick)[near]
    colours = _fitted(border[near], places)
    usual = float(np.quantile(np.linalg.norm(border[near] - places @ colours, axis=1), 0.995))
    return _Ground(colours, noise, window, max(_LEAST_DIFFERENCE, 1.2 * usual))


def _block_means(rgb: np.ndarray, factor: int) -> np.ndarray:
    """rgb [H, W, 3] made smaller by a whole factor, of the same type; pixels left over at the far edges are dropped."""
    height, width = (size // factor for size in rgb.shape[:2])
    means = np.empty((height, width, 3), rgb.dtype)
    for top, bottom in strips(height, width, _STRIP_PIXELS):
        block = rgb[top * factor : bottom * factor, : width * factor]
        parts = (
            block[down::factor, across::factor].astype(np.float32) for down in range(factor) for across in range(factor)
        )
        total = cast(np.ndarray, sum(parts))
        total *= np.float32(1 / factor**2)
        means[top:bottom] = total if rgb.dtype == np.float32 else np.rint(total)
    return means


def _enlarged(alpha: np.ndarray, factor: int, height: int, width: int) -> np.ndarray:
    """The alpha of a picture that _block_means made smaller, as that of the picture itself, [height, width]."""
    bottom, right = (size * factor for size in alpha.shape)
    enlarged = np.empty((height, width), np.float32)
    for down in range(factor):
        for across in range(factor):
            enlarged[down:bottom:factor, across:right:factor] = alpha
    enlarged[bottom:] = enlarged[bottom - 1]
    enlarged[:, right:] = enlarged[:, right - 1 : right]
    return enlarged


def _border(rgb: np.ndarray, thick: int) -> list[np.ndarray]:
    """The four bands [lines, pixels, 3] along the edges, float32 in 0..1; of thick ones only some of the lines."""
    each = max(1, thick // _BAND_LINES)
    middle = rgb[thick:-thick]
    bands = (rgb[:thick], rgb[-thick:], middle[:, :thick].swapaxes(0, 1), middle[:, -thick:].swapaxes(0, 1))
    return [_floats(band[::each]) for band in bands]


def _places(height: int, width: int, thick: int) -> np.ndarray:
    """(1, down, across) of each pixel of _border, its place in -1..1 from edge to edge: [N, 3] float32."""
    down, across = (np.linspace(-1, 1, size, dtype=np.float32) for size in (height, width))
    grids = (np.broadcast_to(values, (height, width))[..., None] for values in (np.float32(1), down[:, None], across))
    return np.stack([np.concatenate([band.ravel() for band in _border(grid, thick)]) for grid in grids], 1)


def _fitted(colours: np.ndarray, places: np.ndarray) -> np.ndarray:
    """_Ground's colours, of pixels [N, 3] at their places [N, 3]. They have a slope where that is clearly seen, as on a
    wall that is lit from the side."""
    level = np.zeros((3, 3), np.float32)
    level[0] = colours.mean(0)
    sloping = np.linalg.lstsq(places.astype(np.float64), colours.astype(np.float64), rcond=None)[0].astype(np.float32)
    return sloping if np.abs(sloping[1:]).max() > _LEAST_SLOPE else level


def _floats(rgb: np.ndarray) -> np.ndarray:
    """Colours as float32 in 0..1."""
    return rgb.astype(np.float32) * np.float32(1 / 255) if rgb.dtype == np.uint8 else rgb.astype(np.float32)


def _noise(bands: list[np.ndarray]) -> float:
    """The standard deviation of noise, per channel, from pixels two apart (JPEG shares colours among neighbours): that
    of a slow gradient is not in it."""
    squares = np.concatenate([(band[:, 2:] - band[:, :-2]).reshape(-1, 3) for band in bands]) ** 2 / 2
    usual = np.sort(squares, 0)[: max(1, round(_USUAL_SHARE * len(squares)))]  # without specks and objects
    return float(np.sqrt(usual.mean()))


def _window_px(noise: float) -> int:
    """Over how many pixels a side to take means, so that noise stays well below the colour distances that count."""
    enough = [window for window in _WINDOWS_PX if 5 * noise / max(1, window - 1) <= _NEAR]
    return enough[0] if enough else _WINDOWS_PX[-1]


def _means(values: np.ndarray, window: int) -> np.ndarray:
    """Means of values [H, W, C] over window x window pixels; beyond the edges the last pixel is repeated."""
    reach = window // 2
    for axis in (0, 1):
        if reach:
            size = values.shape[axis]
            padded = np.pad(values, [(reach, reach) if a == axis else (0, 0) for a in range(3)], mode="edge")
            parts = (padded[(slice(None),) * axis + (slice(at, at + size),)] for at in range(window))
            values = cast(np.ndarray, sum(parts)) / np.float32(window)
    return values


def _distances(rgb: np.ndarray, ground: np.ndarray, window: int) -> np.ndarray:
    """The distance [H, W] float32 of each pixel's colour, a mean over window x window pixels, from the background's.

    ground: _Ground.colours.
    """
    (height, width), reach = rgb.shape[:2], window // 2
    distances = np.empty((height, width), np.float32)
    tables = (_floats(np.arange(256, dtype=np.uint8))[:, None] - ground[0]).T ** 2
    down, across = (np.linspace(-1, 1, size, dtype=np.float32)[:, None] for size in (height, width))
    for top, bottom in strips(height, width, _STRIP_PIXELS):
        if window == 1 and rgb.dtype == np.uint8 and not ground[1:].any():
            squares = (tables[channel][rgb[top:bottom, :, channel]] for channel in range(3))
        else:
            first = max(0, top - reach)
            block = _floats(rgb[first : bottom + reach]) - (ground[0] + across * ground[2])
            block -= (down[first : bottom + reach] * ground[1])[:, None]
            block = _means(block, window)[top - first :][: bottom - top]
            squares = (block[..., channel] ** 2 for channel in range(3))
        np.sqrt(sum(squares), out=distances[top:bottom])
    return distances


def _background(distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What belongs to the background, bool [H, W], and of that the holes, which are not connected to the border."""
    height, width = distance.shape
    thick = max(1, round(_BORDER_SHARE * min(height, width)))
    ring = np.ones((height, width), bool)
    ring[thick:-thick, thick:-thick] = False
    side = max(3, round(_PATCH_SHARE * min(height, width)))
    pieces = Pieces.of(distance < _FAR, diagonal=False)
    from_border, from_patch = pieces.hit(ring), pieces.hit(full_squares(distance < _SAME, side))
    return pieces.mask(from_border | from_patch), pieces.mask(from_patch & ~from_border)


def full_squares(flags: np.ndarray, side: int) -> np.ndarray:
    """The pixels [H, W] at whose lower right a square of `side` pixels is all set."""
    full = flags
    for axis in (0, 1):
        full, covered = full.swapaxes(0, axis), 1
        while covered < side:  # each step joins two stretches of what is covered so far
            step = min(covered, side - covered)
            full, covered = full[:-step] & full[step:], covered + step
        full = full.swapaxes(0, axis)
    return np.pad(full, [(0, before - after) for before, after in zip(flags.shape, full.shape)])


def _sharpened(outside: np.ndarray, distance: np.ndarray, raw: np.ndarray, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """outside and distance without the fringe round the object, where means took in some of its colour."""
    fringe = _grown(outside, reach)
    fringe &= raw < _FAR
    fringe |= outside
    return fringe, np.minimum(distance, raw, out=distance)


def _grown(flags: np.ndarray, reach: int) -> np.ndarray:
    """The pixels [H, W] that are set within a square of so many pixels to each side."""
    grown = flags
    for axis in (0, 1):
        before, grown = grown, grown.copy()
        for step in range(1, reach + 1):
            for one, other in ((np.s_[step:], np.s_[:-step]), (np.s_[:-step], np.s_[step:])):
                target, source = (one, other) if axis == 0 else ((slice(None), one), (slice(None), other))
                grown[target] |= before[source]
    return grown


def _shares_lost(outside: np.ndarray, holes: np.ndarray, distance: np.ndarray, differs: float) -> tuple[float, float]:
    """PlainCut's faded and holes; differs: the colour distance from which on a pixel is not of the background's colour.

    Of a white body before white everything goes, or all but its outline: then its shades are counted as faded, and the
    rest is taken for holes.
    """
    step = max(1, round(max(distance.shape) / _SHARE_SAMPLES))  # of a large picture, some of the pixels will do
    outside, holes, distance = (values[::step, ::step] for values in (outside, holes, distance))
    opaque = distance > (_NEAR + _FAR) / 2
    opaque |= ~outside
    other = distance > differs
    object_ = object_pieces(opaque.astype(np.float32), 1)[0]
    other &= object_ | ~opaque  # leaves out specks
    opaque = object_
    between = _between(opaque, 0) | _between(opaque, 1)
    between &= ~opaque
    bodies = _with_sharp_edges(other & ~opaque, other, distance, differs)
    bodies &= ~_grown(opaque, round(_BLOCK_PX / step))
    faded = other & ~opaque & (between | bodies)
    seen_through = between & holes & ~other
    kept, gone, hollow = (int(np.count_nonzero(pixels)) for pixels in (opaque, faded, seen_through))
    enclosed = max(1, kept + gone + hollow)
    return gone / enclosed, hollow / enclosed


def _with_sharp_edges(pale: np.ndarray, other: np.ndarray, distance: np.ndarray, differs: float) -> np.ndarray:
    """The pieces of `pale` [H, W], which hardly differ from the background, that end at it as a body does and not as a
    soft shadow: a few pixels inside `other`, what is not of the background's colour, they differ from it clearly."""
    depth, inner = np.zeros(other.shape, np.int8), other
    for _ in range(_EDGE_PX + 1):
        depth += inner
        padded = np.pad(inner, 1)
        inner = inner & padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    ring = pale & (depth == _EDGE_PX)
    pieces = Pieces.of(pale, diagonal=True)
    sharp = pieces.masses((ring & (distance > _CLEARLY * differs)).astype(np.float32))
    return pieces.mask(sharp > _SHARP_SHARE * np.maximum(1, pieces.masses(ring.astype(np.float32))))


def _between(flags: np.ndarray, axis: int) -> np.ndarray:
    """Whether there is a flag on both sides of each pixel along the axis, or on it."""
    forwards = np.maximum.accumulate(flags, axis)
    return forwards & np.flip(np.maximum.accumulate(np.flip(flags, axis), axis), axis)
