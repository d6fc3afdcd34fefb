"""What crops of photos on a device are compared with those of the host on: a GPU, or the CUDA kernels compiled for the
CPU."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.models.crop import crop_on_device, crop_resize_premultiplied, object_square


class Case(NamedTuple):
    """A photo, the box of its object (top, bottom, left, right), whether it is of bytes, and the sizes of the crops."""

    height: int
    width: int
    box: tuple[int, int, int, int]
    is_bytes: bool
    sizes_px: tuple[int, ...] = (32, 128)


CASES = [
    Case(90, 70, (20, 80, 10, 50), True),
    Case(37, 300, (0, 37, 120, 300), True, (16, 300)),  # the square reaches beyond the photo; more than a block
    Case(300, 37, (290, 291, 0, 1), False),  # a pixel
    Case(64, 64, (0, 64, 0, 64), False, (74,)),  # as many pixels as the square has
    Case(5, 3, (1, 3, 1, 2), True),
]


def photo(case: Case) -> Tensor:
    random = np.random.default_rng(case.width)
    rgba = torch.from_numpy(random.integers(0, 256, (case.height, case.width, 4), np.uint8))
    top, bottom, left, right = case.box
    inside = torch.zeros(case.height, case.width, dtype=torch.bool)
    inside[top:bottom, left:right] = True
    rgba[..., 3] = torch.where(inside, rgba[..., 3].clamp_min(51), rgba[..., 3].clamp_max(50))
    return rgba if case.is_bytes else rgba / 255


def cropped(case: Case, device: str = "cpu") -> list[Tensor]:
    checks, crops = crop_on_device(photo(case).to(device), case.sizes_px)
    assert checks.tolist() == [1, 1]
    return [crop.cpu() for crop in crops]


def refused(device: str = "cpu") -> list[list[float]]:
    """The checks of a photo without an object, and of two with values out of range."""
    found = []
    for value in (0.1, 1.5, float("nan")):
        rgba = torch.full((7, 9, 4), 0.19)
        rgba[3, 4, 2] = value
        found.append(crop_on_device(rgba.to(device), [8])[0].tolist())
    return found


def compare(found: list[list[Tensor]], checks: list[list[float]]) -> None:
    for case, crops in zip(CASES, found, strict=True):
        rgba = photo(case)
        square = object_square(rgba[..., 3])
        for size, crop in zip(case.sizes_px, crops, strict=True):
            expected = crop_resize_premultiplied(rgba, square, size)
            torch.testing.assert_close(crop, expected, rtol=0, atol=2e-5)
    assert checks == [[1, 0], [0, 0], [0, 0]]
