"""What the second eye of a stereo pair sees behind the edges of the first one's picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.photo.hidden import Hidden
from lightfield_gs.photo.image_filters import max_filter


@dataclass(frozen=True)
class SecondEyeConstants:
    """Tolerances of what counts as the same surface.

    All are chosen by hand and not tuned on a data set.
    """

    same_px: float = 1.5  # difference of parallax up to which both eyes see one surface
    mixed_px: int = 1  # pixels beside an edge whose colours are mixed with those of the surface in front
    cover_px: int = 4  # pixels around a hidden one, of the fringe, within which its cover stands
    steps: int = 4  # of the search for where the surface stands


_C = SecondEyeConstants()


@dataclass
class SecondEye:
    """The right eye's picture, at the size of the left one, its rows level with it.

    The parallax x_left - x_right of a surface is per_inverse / z + offset.

    Attributes:
        image: [H, W, 3], 0..1, in the brightness of the left picture.
        inverse: [H, W], 1/z of its pixels, 1 / scene units.
        per_inverse: Pixels times scene units.
        offset: Pixels.
    """

    image: Tensor
    inverse: Tensor
    per_inverse: float
    offset: float

    def fill(self, found: Hidden, behind: Tensor, depth: Tensor) -> tuple[Hidden, Tensor]:
        """Return the hidden layer and its colours with what this eye sees of it.

        Args:
            found: Of the left picture.
            behind: [H, W, 3], its colours so far.
            depth: [H, W], z of the left picture.
        """
        rows, columns = found.hole.nonzero().unbind(1)
        inverse, image = self.inverse.to(depth), self.image.to(behind)
        width, step = depth.shape[1], _C.same_px / abs(self.per_inverse)
        in_front = max_filter(inverse, _C.mixed_px)
        there = found.disparity[rows, columns]
        # Where this eye sees a surface depends on its distance: from the guess to what stands there, and again
        for _ in range(_C.steps):
            place = columns - (self.per_inverse * there + self.offset)
            column = place.round().long().clamp(0, width - 1)
            there = inverse[rows, column]
        back = column + self.per_inverse * there + self.offset
        sees = ((back - columns).abs() < _C.same_px) & (place >= 0) & (place <= width - 1)
        # Behind the cover, and clear of what stands before it for this eye
        cover = max_filter((1 / depth).nan_to_num(0), _C.cover_px)[rows, columns]
        sees &= (there < cover - step) & (in_front[rows, column] - there < step)
        left = place.floor().long().clamp(0, width - 2)
        there, place = there[sees], place[sees]
        rows, columns, left = rows[sees], columns[sees], left[sees]
        part = (place - left).clamp(0, 1)[:, None]
        colours, disparity = behind.clone(), found.disparity.clone()
        colours[rows, columns] = (1 - part) * image[rows, left] + part * image[rows, left + 1]
        disparity[rows, columns] = there
        return found._replace(disparity=disparity), colours


def second_eye(left: np.ndarray, right: np.ndarray, z: np.ndarray, shifts: np.ndarray, others: np.ndarray) -> SecondEye:
    """Return the second eye of a pair.

    Args:
        left: uint8 [H, W, 3].
        right: The same of the right eye, level.
        z: [H, W], distances of the left picture.
        shifts: [H, W], x_left - x_right of the left picture, pixels, from which the distances were made.
        others: The same of the right picture.
    """
    # Distances are linear in the parallax but at their ends, where they are cut
    low, high = np.percentile(shifts, [5, 95])
    inner = (shifts >= low) & (shifts <= high)
    inverse = 1 / z[inner].astype(np.float64)
    if high - low < 1e-3 or np.ptp(inverse) < 1e-9:
        per_inverse, offset = 1e-6, float(low)
    else:
        per_inverse, offset = np.polyfit(inverse, shifts[inner].astype(np.float64), 1)
    own, other = ((eye / np.float32(255)).reshape(-1, 3) for eye in (left, right))
    picture = (right / np.float32(255) - other.mean(0)) * (own.std(0) / np.maximum(other.std(0), 1e-3)) + own.mean(0)
    seen = np.maximum((others - offset) / per_inverse, 1e-12)
    return SecondEye(
        torch.from_numpy(picture.clip(0, 1).astype(np.float32)),
        torch.from_numpy(seen.astype(np.float32)),
        float(per_inverse),
        float(offset),
    )
