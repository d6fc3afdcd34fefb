"""Images that a device compresses for PNG files, a GPU or the CUDA kernels compiled for the CPU, against zlib."""

import zlib

import numpy as np
import torch

from lightfield_gs.io.images import read_image, write_image
from lightfield_gs.io.png import CompressedImage, compressed_image, deflate

RNG = np.random.default_rng(11)
SEGMENT, PIECE = 128, 96 * 128  # of a row, in csrc/cuda/png/deflate.cu
LONGEST = PIECE + SEGMENT


def _runs() -> np.ndarray:
    """Runs of all lengths, some of them from one segment into others, below rows whose filtered bytes are 2 as well."""
    lengths = np.concatenate([np.arange(1, 300), RNG.geometric(0.02, 400)])
    row = np.repeat(np.arange(len(lengths)) * 7 % 251, lengths)[:LONGEST].astype(np.uint8)
    return np.cumsum([row, row * 0 + 2, np.roll(row, 60)], 0, np.uint8)[..., None]


def _skewed() -> np.ndarray:
    """Bytes as often as Fibonacci's numbers: the best code for them has up to 24 bits."""
    counts = np.round(1.618 ** np.arange(25)).astype(int)
    return RNG.permutation(np.repeat(np.arange(25, dtype=np.uint8) * 9 + 1, counts))[None, :, None]


IMAGES = {
    "noise": RNG.integers(0, 256, (9, 700, 3), dtype=np.uint8),
    "one": np.full((1, 1, 1), 7, np.uint8),
    "colour": np.full((40, 300, 3), (200, 0, 31), np.uint8),
    "black": np.zeros((70, LONGEST // 4, 4), np.uint8),
    "last pixel": np.pad(np.ones((1, 1, 3), np.uint8), ((50, 0), (99, 0), (0, 0))),
    "first row": np.pad(np.ones((1, 1, 3), np.uint8), ((0, 0), (40, 0), (0, 0))),
    "geometric": RNG.geometric(0.5, (60, 400, 4)).astype(np.uint8),
    "many": RNG.integers(0, 3, (1100, 40, 3), dtype=np.uint8),  # more pieces than are placed at once
    "runs": _runs(),
    "skewed": _skewed(),
    **{f"{size} bytes": RNG.integers(0, 2, (3, size, 1), np.uint8) for size in (127, 128, 129, PIECE, PIECE + 1)},
}


def compressed(name: str, device: str = "cpu") -> dict[str, object]:
    """Return the device's PNG stream of an image."""
    out, facts = deflate(torch.from_numpy(IMAGES[name]).to(device))
    image = compressed_image(IMAGES[name].shape, out, facts.cpu().numpy())
    stream = bytearray(b"".join(bytes(part) for part in image.stream))
    return {"stream": torch.frombuffer(stream, dtype=torch.uint8), "is_plain": image.is_plain}


def compare(name: str, found: dict[str, object], folder) -> None:
    """zlib reads the filtered rows and checks their checksum; a reader of PNG files reads the pixels.

    The stream is as short as runs and the best code make it.
    """
    image, stream = IMAGES[name], found["stream"].numpy().tobytes()
    rows = image.reshape(len(image), -1)
    filtered = np.diff(rows, axis=0, prepend=rows[:1] * 0)
    expected = np.pad(filtered, ((0, 0), (1, 0)), constant_values=2).tobytes()
    decoder = zlib.decompressobj()
    assert decoder.decompress(stream) == expected and decoder.eof and decoder.unused_data == b""
    assert found["is_plain"] == (image == image[0, 0]).all()
    by_runs = zlib.compressobj(9, zlib.DEFLATED, 15, 9, zlib.Z_RLE)
    size = len(by_runs.compress(expected) + by_runs.flush())
    # A header of 153 bytes; a run that ends with a segment costs two bytes at the most, and so does what begins there
    assert len(stream) <= 1.01 * size + 160 + 4 * (len(expected) // SEGMENT + len(rows))
    if image.shape[1] > 65536:  # more than a file may have
        return
    path = folder / "a.png"
    write_image(path, CompressedImage(image.shape, (stream,), found["is_plain"]), {"said": "so"})
    assert np.array_equal(read_image(path, as_stored=True), image)
