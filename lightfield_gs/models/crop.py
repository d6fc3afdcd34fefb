"""Crop a picture to its object, for training and inference alike: the network sees one kind of input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError

# Room left round the object's bounding box, as a share of its longer side (on each side).
MARGIN = 0.08
# A pixel belongs to the object from this opacity on; fainter ones are shadows and the haze of automatic cut-outs.
_OBJECT_ALPHA = 0.2
_STRIP_PIXELS = 1 << 20
Number = TypeVar("Number")


@dataclass(frozen=True)
class Square(Generic[Number]):
    """A square of whole pixels: left and top edge (may be negative) and side length. It may reach beyond the image.

    Many squares may be one Square whose fields are arrays.
    """

    left: Number
    top: Number
    side: Number

    def intrinsics(
        self: Square[int], focal: tuple[float, float], centre: tuple[float, float], size_px: int
    ) -> list[float]:
        """(fx, fy, cx, cy) in pixels after the square was cut out and resized to size_px."""
        scale = size_px / self.side
        return [focal[0] * scale, focal[1] * scale, (centre[0] - self.left) * scale, (centre[1] - self.top) * scale]


def object_square(alpha: Tensor, margin: float = MARGIN) -> Square[int]:
    """The square round the object, centred on its bounding box, with `margin` times its longer side left on each side.

    alpha: [H,W], 0..1 or uint8. Raises InputError when nothing is opaque.
    """
    opaque = alpha >= least_opaque(alpha.dtype)
    check_object(opaque.any())
    (top, bottom), (left, right) = (_span(opaque.any(axis)) for axis in (1, 0))
    side = max(2, round(max(bottom - top, right - left) * (1 + 2 * margin)))
    return Square((left + right - side) // 2, (top + bottom - side) // 2, side)


def least_opaque(dtype: torch.dtype) -> float:
    """The alpha from which on a pixel belongs to the object, in 0..1, or of uint8."""
    return _OBJECT_ALPHA if dtype.is_floating_point else round(255 * _OBJECT_ALPHA)


def check_object(there_is_one: float | Tensor) -> None:
    """Raises InputError unless there is an object."""
    if not there_is_one:
        raise InputError("empty mask: expected an object with opaque pixels, every pixel is transparent")


def _span(flags: Tensor) -> tuple[int, int]:
    """Index of the first flag that is set, and one more than that of the last."""
    return int(flags.int().argmax()), len(flags) - int(flags.flip(0).int().argmax())


def crop_resize(image: Tensor, square: Square[int], size_px: int) -> Tensor:
    """Cut the square out of image [C,H,W] (zero beyond its edges) and resize it to [C,size_px,size_px], antialiased.

    Colours must be premultiplied by alpha, or the background would bleed into the outline. Returns float32 in the range
    of the input, which may be uint8.
    """
    height, width = image.shape[1:]
    right, bottom = square.left + square.side, square.top + square.side
    inside = image[:, max(0, square.top) : max(0, bottom), max(0, square.left) : max(0, right)]
    padding = (max(0, -square.left), max(0, right - width), max(0, -square.top), max(0, bottom - height))
    padded = F.pad(inside.float(), padding)
    return _resized(padded, (size_px, size_px))


def crop_resize_premultiplied(image: Tensor, square: Square[int], size_px: int) -> Tensor:
    """crop_resize of image [H,W,4], uint8 or float32 in 0..1, whose alpha is straight: [4,size_px,size_px], multiplied.

    It is done for a strip of rows at a time, across and then down, which is how the filter goes anyway: a whole photo
    of 50 megapixels in floating point, once as it is and once multiplied, would take 1.6 GB.
    """
    rows = range(max(0, square.top), min(image.shape[0], square.top + square.side))
    each = max(1, _STRIP_PIXELS // square.side)
    parts = []
    for top in range(rows.start, rows.stop, each):
        strip = premultiplied(image[top : min(rows.stop, top + each), max(0, square.left) : square.left + square.side])
        strip = F.pad(strip, (max(0, -square.left), max(0, square.left + square.side - image.shape[1])))
        parts.append(_resized(strip, (strip.shape[1], size_px)))
    narrow = torch.cat(parts, 1)
    narrow = F.pad(narrow, (0, 0, max(0, -square.top), max(0, square.top + square.side - image.shape[0])))
    return _resized(narrow, (size_px, size_px))


def premultiplied(photo: Tensor) -> Tensor:
    """float32 [4,H,W], colours times alpha, of a photo [H,W,4], uint8 or float32 in 0..1."""
    image = photo.permute(2, 0, 1).float()
    if photo.dtype == torch.uint8:
        image = image / 255
    return torch.cat([image[:3] * image[3:], image[3:]])


def _resized(image: Tensor, size: tuple[int, int]) -> Tensor:
    """image [C,H,W] float32 at another size (height, width), antialiased."""
    if tuple(image.shape[1:]) == size:
        return image
    return F.interpolate(image[None], size=size, mode="bilinear", antialias=True)[0]


def crop_on_device(photo: Tensor, sizes_px: Sequence[int]) -> tuple[Tensor, list[Tensor]]:
    """crop_resize_premultiplied of photo [H,W,4], uint8 or float32, contiguous on CUDA, to the square round its object
    at each of these sizes, [4,S,S]. First come two numbers [2] that are 0 where its values are not in 0..1, and where
    there is no object; of such photos the crops mean nothing. All sizes are made by kernels that a graph can hold.
    """
    height, width = photo.shape[:2]
    found = torch.empty(_core.cuda.FOUND_NUMBERS, dtype=torch.int32, device=photo.device)
    checks = torch.empty(2, device=photo.device)
    is_bytes = photo.dtype == torch.uint8
    job = _core.cuda.Photo(
        height=height,
        width=width,
        bytes=photo.data_ptr() if is_bytes else 0,
        floats=0 if is_bytes else photo.data_ptr(),
        opaque=least_opaque(photo.dtype),
        margin=MARGIN,
        found=found.data_ptr(),
        checks=checks.data_ptr(),
    )
    crops = []
    with torch.cuda.device_of(photo):
        stream = torch.cuda.current_stream().cuda_stream
        _core.cuda.find_object(job, stream)
        for size in sizes_px:
            narrow, out = (torch.empty(shape, device=photo.device) for shape in ((height, size, 4), (4, size, size)))
            _core.cuda.crop_object(job, size, narrow.data_ptr(), out.data_ptr(), stream)
            crops.append(out)
    return checks, crops
