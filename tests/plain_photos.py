"""Photos of a thing before a plain background, their files, and their cut-outs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from lightfield_gs.io.images import read_picture
from lightfield_gs.photo.load import cut_out_photo
from lightfield_gs.photo.photo import Photo
from lightfield_gs.show.preview import to_integers

HEIGHT, WIDTH, GREY = 240, 320, 0.92
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]


def round_thing(row=130, column=170, radius=50) -> np.ndarray:
    return np.hypot(ROWS - row, COLUMNS - column) < radius


THING = round_thing() | (abs(COLUMNS - 170) < 2) & (ROWS > 40) & (ROWS < 130)  # with a thin rod


def picture(mask=THING, colour=(0.8, 0.1, 0.1), background=GREY) -> np.ndarray:
    return np.where(mask[..., None], colour, background).astype(np.float64)


def save(path: Path, values: np.ndarray, **options) -> Path:
    """Write values [H, W, ...] in 0..1 with Pillow, and return the path."""
    if path.suffix == ".jpg":
        options = {"quality": 95, "subsampling": 0, **options}
    Image.fromarray(to_integers(values, 8)).save(path, **options)
    return path


def photo(path: Path, *mask, **options) -> Photo:
    """Return load_photo with its messages."""
    return cut_out_photo(path, read_picture(path), *mask, **options)
