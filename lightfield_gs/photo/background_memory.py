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

    Attributes:
        resets: How often it began anew, beside the first time.
    """

    def __init__(self) -> None:
        self._kept: Remembered | None = None
        self._first = torch.empty(0)  # the picture since which the camera stands still, small
        self._last = torch.empty(0)
        self.resets = 0

    def update(self, colours: Tensor, disparity: Tensor, is_clear: Tensor) -> Remembered:
        """Take a picture, and return what is remembered after it.

        Args:
            colours: [3, h, w], 0..1.
            disparity: [h, w], > 0.
            is_clear: bool [h, w], the pixels whose colours are of one surface: others are at an edge.
        """
        small = _small(colours)
        kept = self._kept
        if kept is not None and (kept.disparity.shape != disparity.shape or self._has_moved(small)):
            kept, self.resets = None, self.resets + 1
        self._last = small
        if kept is None:
            self._first = small
            self._kept = Remembered(is_clear.clone(), disparity.clone(), colours.clone())
            return self._kept
        ratio = disparity / kept.disparity
        is_new = is_clear & (~kept.is_known | (ratio < _C.farther))
        is_same = is_clear & kept.is_known & (ratio >= _C.farther) & (ratio <= _C.nearer)
        weight = torch.where(is_new, 1.0, torch.where(is_same, _C.new, 0.0))
        self._kept = Remembered(
            kept.is_known | is_clear,
            torch.lerp(kept.disparity, disparity, weight),
            torch.lerp(kept.colours, colours, weight),
        )
        return self._kept

    def _has_moved(self, small: Tensor) -> bool:
        """Return whether the camera, or the whole picture, has changed since the first picture that is remembered."""
        if is_cut(self._last.movedim(0, 2), small.movedim(0, 2)):
            return True
        return has_moved(self._first.mean(0), small.mean(0))


def has_moved(before: Tensor, after: Tensor) -> bool:
    """Return whether most of a picture [h, w], 0..1, is elsewhere in the second, or not in it.

    It is, where the second differs less from the first after a shift. Of each pixel only so much difference counts that
    things that move before what stands still do not decide.
    """
    down, across = _C.shifts_px
    padded = pad(before[None], (across, across, down, down), value=torch.nan)[0]
    windows = padded.unfold(0, before.shape[0], 1).unfold(1, before.shape[1], 1)
    costs = (windows - after).abs().clamp(max=_C.most).nanmean((2, 3))
    still, best, usual = torch.stack([costs[down, across], costs.min(), costs.median()]).tolist()
    return best < _C.better * still or (usual > _C.visible and still > _C.unlike * usual)


def _small(colours: Tensor) -> Tensor:
    """Return a picture [3, h, w] whose longer side has at most side_px pixels."""
    scale = min(1.0, _C.side_px / max(colours.shape[1:]))
    size = [max(1, round(scale * side)) for side in colours.shape[1:]]
    return interpolate(colours[None], size=size, mode="area")[0]
