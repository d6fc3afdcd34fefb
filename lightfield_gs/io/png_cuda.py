"""Compresses images for PNG files on the CUDA device that has them: an image of 8K takes an H100 a millisecond and a
core a tenth of a second or more, and a third or less of the bytes have to be copied to the host. csrc/cuda/png/png.h
says how."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.cuda import device_guard, to_numpy
from lightfield_gs.base.options import Compression
from lightfield_gs.io.png_file import CompressedImage

_ZLIB_HEADER = b"\x78\x01"  # deflate with a window of 32 KB, by a fast algorithm (RFC 1950, section 2.2)


def deflates(image: Tensor, path: Path, compression: Compression) -> bool:
    """Whether the file of an image is to be compressed where the image is."""
    is_compressed = path.suffix.lower() == ".png" and compression == "fast"
    return image.is_cuda and image.dtype == torch.uint8 and is_compressed


def fetched(image: Tensor, path: Path, compression: Compression) -> np.ndarray | CompressedImage:
    """An image [H, W, C] on the host, as write_image takes it for this file. Waits for it."""
    if not deflates(image, path, compression):
        return to_numpy(image)
    out, facts = deflated(image)
    return compressed_image(tuple(image.shape), out, to_numpy(facts))


def deflated(image: Tensor) -> tuple[Tensor, Tensor]:
    """The deflate stream of an image's filtered rows, and facts of it, both uint8 on the image's device: what
    `compressed_image` takes. The stream is at the start of the first, which has room for the longest.

    image: uint8 [H, W, C], contiguous. Nothing waits.
    """
    height, width, channels = image.shape
    native = _core.cuda.PngImage(height=height, width=width, channels=channels, pixels=image.data_ptr())
    work, out = (image.new_empty(size) for size in (native.work_bytes(), native.stream_bytes()))
    native.place(work.data_ptr(), out.data_ptr())
    with device_guard(image.device):
        _core.cuda.deflate(native, torch.cuda.current_stream(image.device).cuda_stream)
    return out, work[: _core.cuda.DEFLATE_FACTS_BYTES]


def compressed_image(shape: tuple[int, ...], out: Tensor, facts: np.ndarray) -> CompressedImage:
    """What `deflated` found of an image of this shape, as write_image takes it; `facts` are on the host already. Waits
    for the copy of the stream alone, on the current CUDA stream."""
    bits, adler, is_varied = struct.unpack("QII", facts.tobytes())
    stream = to_numpy(out[: (bits + 7) // 8])
    return CompressedImage(shape, (_ZLIB_HEADER, stream.data, struct.pack(">I", adler)), not is_varied)
