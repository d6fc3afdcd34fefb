"""Cropping a photo on CUDA without waiting for it: lightfield_gs/models/crop.py for where only the device knows the
square."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.models.crop import MARGIN, least_opaque


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
