"""A photo as it was read, and its reduction."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch

from lightfield_gs.io.images import as_floats


@dataclass
class Photo:
    """A photo, read and cut out.

    Attributes:
        pixels: RGBA [H, W, 4] in sRGB, upright, uint8 or float32 in 0..1, alpha straight.
        orientation: The Exif orientation that was undone.
        messages: The decisions that were made.
        notes: Doubts about them.
        full_size: Height and width before `reduce_photo`; None: the pixels are all there were.
    """

    pixels: np.ndarray
    orientation: int = 1
    messages: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    full_size: tuple[int, int] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the photo in its file, upright, which its camera is told in."""
        return self.full_size or (self.pixels.shape[0], self.pixels.shape[1])

    def floats(self) -> np.ndarray:
        """Return the pixels as float32 in 0..1."""
        return as_floats(self.pixels)


def reduce_photo(photo: Photo, most_pixels: int) -> None:
    """Average the pixels of a photo with more than `most_pixels`, in place."""
    height, width = photo.pixels.shape[:2]
    scale = math.sqrt(most_pixels / (height * width))
    if scale >= 1:
        return
    size = max(1, int(height * scale)), max(1, int(width * scale))
    values = torch.from_numpy(photo.floats())
    values[..., :3] *= values[..., 3:]
    values = torch.nn.functional.interpolate(values.movedim(2, 0)[None], size=size, mode="area")[0].movedim(0, 2)
    values[..., :3] /= values[..., 3:].clamp(min=1e-6)
    pixels = values.numpy()
    photo.full_size = height, width
    photo.pixels = pixels if photo.pixels.dtype == np.float32 else np.rint(255 * pixels).astype(np.uint8)
    photo.messages.append(f"reduced to {size[1]} x {size[0]}")
