"""PNG files of our own, as Pillow and zlib read them."""

import io
import warnings

import numpy as np
import pytest
from PIL import Image

from lightfield_gs.io.images import read_image, read_info, write_image
from lightfield_gs.io.png import stored_png

RNG = np.random.default_rng(4)
ORDER = np.arange(256, dtype=np.uint8)
FIBONACCI = np.repeat(ORDER[:21], np.round(1.618 ** np.arange(21)).astype(int))  # makes a tree 20 deep


@pytest.mark.parametrize(
    "pixels",
    [
        RNG.integers(0, 256, (300, 1501, 3), dtype=np.uint8),  # several blocks, nothing to be saved
        np.zeros((700, 1111, 3), np.uint8),  # runs of all lengths at once
        np.full((1, 1, 1), 7, np.uint8),
        np.repeat(ORDER, ORDER)[None, :, None],  # a run of each length
        RNG.permutation(FIBONACCI)[None, :, None],
        RNG.geometric(0.5, (40, 3000, 4)).astype(np.uint8),
        RNG.integers(0, 65536, (60, 70, 3), dtype=np.uint16),
    ],
    ids=["noise", "plain", "one", "runs", "deep", "alpha", "16 bit"],
)
def test_what_is_written_is_read(pixels, tmp_path):
    path = tmp_path / "a.png"
    write_image(path, pixels[:, ::-1], {"said": "ä\n"})
    assert np.array_equal(read_image(path, as_stored=True), pixels[:, ::-1])
    assert read_info(path).metadata == {"said": "ä\n"}
    if pixels.dtype == np.uint8:  # Pillow has no more bits
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            image = Image.open(path)
            image.load()
        assert np.array_equal(np.asarray(image).reshape(pixels.shape), pixels[:, ::-1])
        assert set(image.text) == {"Description", "Software"}


@pytest.mark.parametrize("width", [1, 7, 21844, 21845])
def test_a_stored_png_has_each_byte(width):
    pixels = np.random.default_rng(0).integers(0, 256, (3, width, 3), np.uint8)
    file = io.BytesIO(stored_png(pixels))
    Image.open(file).verify()
    np.testing.assert_array_equal(np.asarray(Image.open(file)), pixels)
