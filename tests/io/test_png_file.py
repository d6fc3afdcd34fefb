"""PNG files of our own, as Pillow and zlib read them."""

import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from lightfield_gs.io.images import read_image, read_info, write_image
from lightfield_gs.io.png_file import FilteredImage, filtered_rows

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


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_rows_filtered_elsewhere_become_the_same_file(channels, tmp_path):
    pixels = RNG.integers(0, 256, (2300, 1009 * 9 // channels, channels), dtype=np.uint8)  # more than one block
    pixels[:, 100:] = 3
    filtered = FilteredImage(filtered_rows(torch.from_numpy(pixels)).numpy(), channels)
    assert filtered.shape == pixels.shape
    write_image(tmp_path / "a.png", pixels, {"said": "so"})
    write_image(tmp_path / "b.png", filtered, {"said": "so"})
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize("place", [None, (0, 0), (0, 69), (1, 3), (64, 16), (99, 69)])
def test_one_colour_is_seen_in_filtered_rows(place):
    pixels = np.full((100, 70, 3), (7, 0, 200), np.uint8)
    if place:
        pixels[place][1] = 1
    assert FilteredImage(filtered_rows(torch.from_numpy(pixels)).numpy(), 3).is_plain == (place is None)
