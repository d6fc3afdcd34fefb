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
from lightfield_gs.base.stages import run_stage

# Margin on each side of the object's bounding box, as a fraction of its longer side.
MARGIN = 0.08
# Least opacity of the object; fainter pixels are shadows and the haze of automatic cut-outs.
_OBJECT_ALPHA = 0.2
_STRIP_PIXELS = 1 << 20
Number = TypeVar("Number")


@dataclass(frozen=True)
class Square(Generic[Number]):
    """A square of whole pixels, which may reach beyond the image. For many squares the fields are arrays.

    Attributes:
        left, top: first column and row; may be negative.
        side: length.
    """

    left: Number
    top: Number
    side: Number

    def intrinsics(
        self: Square[int], focal: tuple[float, float], centre: tuple[float, float], size_px: int
    ) -> list[float]:
        """Return (fx, fy, cx, cy) in pixels of the cropped and resized square.

        Args:
            focal: (fx, fy) of the image, pixels.
            centre: (cx, cy) of the image, pixels.
            size_px: side of the resized square.
        """
        scale = size_px / self.side
        return [focal[0] * scale, focal[1] * scale, (centre[0] - self.left) * scale, (centre[1] - self.top) * scale]


def object_square(alpha: Tensor, margin: float = MARGIN) -> Square[int]:
    """Return the square round the object, centred on its bounding box.

    Args:
        alpha: [H,W], 0..1 or uint8.
        margin: left on each side, as a fraction of the longer side.

    Raises:
        InputError: when nothing is opaque.
    """
    opaque = alpha >= least_opaque(alpha.dtype)
    check_object(opaque.any())
    (top, bottom), (left, right) = (_span(opaque.any(axis)) for axis in (1, 0))
    side = max(2, round(max(bottom - top, right - left) * (1 + 2 * margin)))
    return Square((left + right - side) // 2, (top + bottom - side) // 2, side)


def least_opaque(dtype: torch.dtype) -> float:
    """Return the least alpha of a pixel of the object, in 0..1, or of uint8."""
    return _OBJECT_ALPHA if dtype.is_floating_point else round(255 * _OBJECT_ALPHA)


def check_object(there_is_one: float | Tensor) -> None:
    """Raise InputError unless there is an object."""
    if not there_is_one:
        raise InputError("empty mask: expected an object with opaque pixels, every pixel is transparent")


def _span(flags: Tensor) -> tuple[int, int]:
    """Return the index of the first set flag, and one more than the index of the last."""
    return int(flags.int().argmax()), len(flags) - int(flags.flip(0).int().argmax())


def crop_resize(image: Tensor, square: Square[int], size_px: int) -> Tensor:
    """Crop an image to a square, and resize it with antialiasing.

    Colours must be premultiplied by alpha, or the background bleeds into the outline.

    Args:
        image: [C,H,W], float or uint8; 0 beyond its edges.
        square: the crop.
        size_px: side of the result.

    Returns:
        [C,size_px,size_px] float32 in the range of the input.
    """
    height, width = image.shape[1:]
    right, bottom = square.left + square.side, square.top + square.side
    inside = image[:, max(0, square.top) : max(0, bottom), max(0, square.left) : max(0, right)]
    padding = (max(0, -square.left), max(0, right - width), max(0, -square.top), max(0, bottom - height))
    padded = F.pad(inside.float(), padding)
    return resized(padded[None], (size_px, size_px))[0]


def crop_resize_premultiplied(image: Tensor, square: Square[int], size_px: int) -> Tensor:
    """Premultiply, crop and resize an image with straight alpha.

    The filter runs along rows and then columns, for a strip of rows at a time. In floating point a whole photo of 50
    megapixels would take 1.6 GB.

    Args:
        image: [H,W,4], uint8 or float32 in 0..1.
        square: the crop.
        size_px: side of the result.

    Returns:
        [4,size_px,size_px] float32, premultiplied.
    """
    rows = range(max(0, square.top), min(image.shape[0], square.top + square.side))
    each = max(1, _STRIP_PIXELS // square.side)
    parts = []
    for top in range(rows.start, rows.stop, each):
        strip = premultiplied(image[top : min(rows.stop, top + each), max(0, square.left) : square.left + square.side])
        strip = F.pad(strip, (max(0, -square.left), max(0, square.left + square.side - image.shape[1])))
        parts.append(resized(strip[None], (strip.shape[1], size_px))[0])
    narrow = torch.cat(parts, 1)
    narrow = F.pad(narrow, (0, 0, max(0, -square.top), max(0, square.top + square.side - image.shape[0])))
    return resized(narrow[None], (size_px, size_px))[0]


def premultiplied(photo: Tensor) -> Tensor:
    """Return float32 [4,H,W], colours times alpha, of a photo [H,W,4], uint8 or float32 in 0..1."""
    image = photo.permute(2, 0, 1).float()
    if photo.dtype == torch.uint8:
        image = image / 255
    return torch.cat([image[:3] * image[3:], image[3:]])


def resized(images: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize images [B,C,H,W] float32 to (height, width) with antialiasing."""
    if tuple(images.shape[2:]) == size:
        return images
    return F.interpolate(images, size=size, mode="bilinear", antialias=True)


def crop_on_device(photo: Tensor, sizes_px: Sequence[int]) -> tuple[Tensor, list[Tensor]]:
    """Crop a photo on CUDA without waiting for the device, by kernels that a graph can hold.

    Args:
        photo: [H,W,4], uint8 or float32, contiguous on CUDA.
        sizes_px: sides of the crops.

    Returns:
        Two numbers [2], which are 0 where values are out of 0..1 and where there is no object; then the crops are
        meaningless. And the crops as of crop_resize_premultiplied, [4,S,S] each.
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
    run_stage("find_object", _core, photo.device, job)
    crops = []
    for size in sizes_px:
        narrow, out = (torch.empty(shape, device=photo.device) for shape in ((height, size, 4), (4, size, size)))
        run_stage("crop_object", _core, photo.device, job, size, narrow.data_ptr(), out.data_ptr())
        crops.append(out)
    return checks, crops
