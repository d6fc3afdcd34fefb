"""Connected pieces of a mask, by runs along its rows: quick and small on pictures of 50 megapixels too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
