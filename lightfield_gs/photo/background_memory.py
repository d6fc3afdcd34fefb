"""What a camera that stands still saw behind what is in front now."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from lightfield_gs.photo.steady_depth import is_cut


@dataclass(frozen=True)
class BackgroundMemoryConstants:
    """Thresholds.

    All are chosen by hand and not tuned on a data set.
    """

    farther: float = 0.95  # disparity by the remembered one, down from which a surface lies behind it
    nearer: float = 1.05  # up to which it is the remembered surface
    new: float = 0.3  # weight of a new picture where it is
    side_px: int = 256  # longer side of the pictures by which motion is found
    shifts_px: tuple[int, int] = (2, 4)  # that are tried, up to these down and across
    most: float = 0.2  # difference of brightness, 0..1, that counts: things that move are few pixels
    better: float = 0.8  # difference after a shift, by that without one, below which the camera has moved
    unlike: float = 0.9  # difference without a shift, by the median of all, above which the picture is another
    visible: float = 0.02  # such a median, from which on the picture is not plain


_C = BackgroundMemoryConstants()


@dataclass
class Remembered:
    """What is remembered, [h, w].

    Attributes:
        is_known: bool [h, w], whether the pixel was seen without anything before it.
        disparity: [h, w], of the farthest surface that was seen there.
        colours: [3, h, w], its colours.
    """

    is_known: Tensor
    disparity: Tensor
    colours: Tensor


class BackgroundMemory:
    """Remembers the farthest surface of each pixel, until the camera moves or the picture is cut.

    Pictures of one size are taken into the same memory, and nothing waits for the device: a graph can hold it.
    """

    def __init__(self) -> None:
        self._kept: Remembered | None = None
        self._first = torch.empty(0)  # the picture since which the camera stands still, small
        self._last = torch.empty(0)

    def update(self, colours: Tensor, disparity: Tensor, is_clear: Tensor) -> Remembered:
        """Take a picture, and return what is remembered after it; the next picture changes it.

        Args:
            colours: [3, h, w], 0..1.
            disparity: [h, w], > 0.
            is_clear: bool [h, w], the pixels whose colours are of one surface: others are at an edge.
        """
        small, kept = _small(colours), self._kept
        if kept is None or kept.disparity.shape != disparity.shape:
            self._first, self._last = small.clone(), small.clone()
            self._kept = Remembered(is_clear.clone(), disparity.clone(), colours.clone())
            return self._kept
        begins = is_cut(self._last.movedim(0, 2), small.movedim(0, 2)) | has_moved(self._first.mean(0), small.mean(0))
        ratio = disparity / kept.disparity
        is_new = begins | (is_clear & (~kept.is_known | (ratio < _C.farther)))
        is_same = is_clear & kept.is_known & (ratio >= _C.farther) & (ratio <= _C.nearer)
        weight = torch.where(is_new, 1.0, torch.where(is_same, _C.new, 0.0))
        kept.is_known.copy_((kept.is_known & ~begins) | is_clear)
        kept.disparity.lerp_(disparity, weight)
        kept.colours.lerp_(colours, weight.expand_as(colours))
        self._first.copy_(torch.where(begins, small, self._first))
        self._last.copy_(small)
        return kept


def has_moved(before: Tensor, after: Tensor) -> Tensor:
    """Return whether most of a picture [h, w], 0..1, is elsewhere in the second, or not in it: a bool [].

    It is, where the second differs less from the first after a shift. Of each pixel only so much difference counts that
    things that move before what stands still do not decide.
    """
    down, across = _C.shifts_px
    padded = pad(before[None], (across, across, down, down), value=torch.nan)[0]
    windows = padded.unfold(0, before.shape[0], 1).unfold(1, before.shape[1], 1)
    costs = (windows - after).abs().clamp(max=_C.most).nanmean((2, 3))
    still, ordered = costs[down, across], costs.flatten().sort().values
    best, usual = ordered[0], ordered[(len(ordered) - 1) // 2]
    return (best < _C.better * still) | ((usual > _C.visible) & (still > _C.unlike * usual))


def _small(colours: Tensor) -> Tensor:
    """Return a picture [3, h, w] whose longer side has at most side_px pixels."""
    scale = min(1.0, _C.side_px / max(colours.shape[1:]))
    size = [max(1, round(scale * side)) for side in colours.shape[1:]]
    return interpolate(colours[None], size=size, mode="area")[0]
