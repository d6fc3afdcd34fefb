"""Compression of images for PNG files on the CUDA device that holds them; see csrc/cuda/png/png.h.

An H100 compresses an 8K image in a millisecond, a CPU core in a tenth of a second or more. At most a third of the bytes
are copied to the host.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.device import device_guard, to_numpy
from lightfield_gs.base.options import Compression
from lightfield_gs.io.png import CompressedImage

_ZLIB_HEADER = b"\x78\x01"  # deflate with a window of 32 KB, by a fast algorithm (RFC 1950, section 2.2)


def is_deflated_on_gpu(image: Tensor, path: Path, compression: Compression) -> bool:
    """Tell whether an image is compressed on its device for the file at `path`."""
    is_compressed = path.suffix.lower() == ".png" and compression == "fast"
    return image.is_cuda and image.dtype == torch.uint8 and is_compressed


def fetch_image(image: Tensor, path: Path, compression: Compression) -> np.ndarray | CompressedImage:
    """Copy an image [H, W, C] to the host in the form that write_image takes for this file; wait for it."""
    if not is_deflated_on_gpu(image, path, compression):
        return to_numpy(image)
    out, facts = deflate(image)
    return compressed_image(tuple(image.shape), out, to_numpy(facts))


def deflate(image: Tensor) -> tuple[Tensor, Tensor]:
    """Compress an image's filtered rows on its device, without waiting.

    Args:
        image: uint8 [H, W, C], contiguous, on a CUDA device.

    Returns:
        A buffer that begins with the deflate stream, and the facts that `compressed_image` needs; both uint8, on the
        image's device.
    """
    height, width, channels = image.shape
    native = _core.cuda.PngImage(height=height, width=width, channels=channels, pixels=image.data_ptr())
    work, out = (image.new_empty(size) for size in (native.work_bytes(), native.stream_bytes()))
    native.place(work.data_ptr(), out.data_ptr())
    with device_guard(image.device):
        _core.cuda.deflate(native, torch.cuda.current_stream(image.device).cuda_stream)
    return out, work[: _core.cuda.DEFLATE_FACTS_BYTES]


def compressed_image(shape: tuple[int, ...], out: Tensor, facts: np.ndarray) -> CompressedImage:
    """Copy the stream of `deflate` to the host; wait for this copy alone, on the current CUDA stream.

    Args:
        shape: H, W, C of the image.
        out: buffer of the stream, on the device.
        facts: facts of the stream, on the host already.
    """
    bits, adler, is_varied = struct.unpack("QII", facts.tobytes())
    stream = to_numpy(out[: (bits + 7) // 8])
    return CompressedImage(shape, (_ZLIB_HEADER, stream.data, struct.pack(">I", adler)), not is_varied)
