"""Cropping a picture to its object, alike for training views and photos: the network sees one kind of input."""
from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs.errors import InputError

# Room left round the object's bounding box, as a share of its longer side (on each side).
MARGIN = 0.08
# A pixel belongs to the object from this opacity on; fainter ones are shadows and the haze of automatic cut-outs.
_OBJECT_ALPHA = 0.2


@dataclass(frozen=True)
class Square:
    """A square of whole pixels: left and top edge (may be negative) and side length. It may reach beyond the image.

    Many squares may be one Square whose fields are arrays.
    """
    left: int
    top: int
    side: int

    def intrinsics(self, focal: tuple[float, float], centre: tuple[float, float], size_px: int) -> list[float]:
        """(fx, fy, cx, cy) in pixels after the square was cut out and resized to size_px."""
        scale = size_px / self.side
        return [focal[0] * scale, focal[1] * scale, (centre[0] - self.left) * scale, (centre[1] - self.top) * scale]


def object_square(alpha: Tensor, margin: float = MARGIN) -> Square:
    """The square round the object, centred on its bounding box, with `margin` times its longer side left on each side.

    alpha: [H,W], 0..1. Raises InputError when nothing is opaque.
    """
    opaque = alpha >= _OBJECT_ALPHA
    rows, columns = opaque.any(1).nonzero()[:, 0], opaque.any(0).nonzero()[:, 0]
    if len(rows) == 0:
        raise InputError("empty mask: expected an object with opaque pixels, every pixel is transparent")
    top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    side = max(2, round(max(bottom - top, right - left) * (1 + 2 * margin)))
    return Square((left + right - side) // 2, (top + bottom - side) // 2, side)


def crop_resize(image: Tensor, square: Square, size_px: int) -> Tensor:
    """Cut the square out of image [C,H,W] (zero beyond its edges) and resize it to [C,size_px,size_px], antialiased.

    Colours must be premultiplied by alpha, or the background would bleed into the outline. Returns float32 in the range
    of the input, which may be uint8.
    """
    height, width = image.shape[1:]
    right, bottom = square.left + square.side, square.top + square.side
    inside = image[:, max(0, square.top):max(0, bottom), max(0, square.left):max(0, right)]
    padding = (max(0, -square.left), max(0, right - width), max(0, -square.top), max(0, bottom - height))
    padded = F.pad(inside.float(), padding)
    if square.side == size_px:
        return padded
    return F.interpolate(padded[None], size=(size_px, size_px), mode="bilinear", antialias=True)[0]
