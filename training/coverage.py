"""Does a rendered object hold together: tears, fog, holes and ghosts of its opacity.

Tears and fog need no truth, only the opacity of renders. Holes and ghosts compare it with the true opacity. All are
fractions of the object's pixels. Lengths are in pixels of the frames for which the constants are given, and scale with
the frames.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

_SOLID = 0.8  # least opacity of a surface without holes
_CLOSED_PX, _WIDTH_PX = 5, 1400  # gaps up to twice as wide are tears, in frames of this width
_FOG = (0.05, 0.6)  # opacities of fog
_OUTLINE = 0.5  # opacity at the true outline
_INSIDE_PX, _OUTSIDE_PX, _LONGER_SIDE_PX = 2, 4, 512  # distances from the outline, in frames of this size
_GHOST = 0.2  # least opacity of a ghost


def tears_and_fog(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Return the fraction of each view's object that is torn, and the fraction that is fog, [V] each.

    The object is what is solid after a morphological closing. Tears are the pixels that the closing adds, which
    includes narrow gaps that the photo itself has: compare oblique views with the photo's own.

    Args:
        alpha: rendered opacities [V,H,W].
    """
    solid = alpha >= _SOLID
    closed = _closed(solid, _scaled(_CLOSED_PX, alpha.shape[2], _WIDTH_PX))
    torn, fog = closed & ~solid, (alpha > _FOG[0]) & (alpha < _FOG[1])
    return _fraction(torn, closed), _fraction(fog, closed)


def holes_and_ghosts(alpha: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the fraction of holes within the true outline, and of ghosts beside it, [V] each.

    A hole is not solid, some pixels inside the true outline. A ghost is visible, some pixels outside it; ghosts are
    relative to the object's area.

    Args:
        alpha: rendered opacities [V,H,W].
        truth: true opacities [V,H,W].
    """
    inside, outside = inside_and_outside(truth)
    return _fraction((alpha < _SOLID) & inside, inside), _fraction((alpha > _GHOST) & outside, truth >= _OUTLINE)


def inside_and_outside(truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return which pixels are inside the outline of true opacities [V,H,W] and which outside it, by some pixels."""
    there, size = truth >= _OUTLINE, max(truth.shape[1:])
    inside = ~_grown(~there, _scaled(_INSIDE_PX, size, _LONGER_SIDE_PX))
    return inside, ~_grown(there, _scaled(_OUTSIDE_PX, size, _LONGER_SIDE_PX))


def _scaled(length_px: int, size: int, given: int) -> int:
    return max(1, round(length_px * size / given))


def _grown(mask: Tensor, reach: int) -> Tensor:
    """Dilate masks [V,H,W] by a square of 2 * reach + 1 pixels."""
    return F.max_pool2d(mask.float()[:, None], 2 * reach + 1, 1, reach)[:, 0] > 0


def _closed(mask: Tensor, reach: int) -> Tensor:
    return ~_grown(~_grown(mask, reach), reach)


def _fraction(part: Tensor, whole: Tensor) -> Tensor:
    return part.sum((1, 2)) / torch.clamp(whole.sum((1, 2)), min=1)
