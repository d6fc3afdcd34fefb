"""Pixels of views in sRGB, whatever their files hold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.io.images import Picture, as_floats, read_picture
from lightfield_gs.photo.colour import check_finite, in_srgb, is_linear


class ViewColours:
    """Reads views in three channels of sRGB, and keeps what it did to them.

    background: red, green and blue in 0..1 behind pictures with alpha. keeps_linear: linear ones stay so, for a file of
    linear samples. messages: what was done to the colours, each once. notes: what may be wrong with them.
    """

    def __init__(self, background: Sequence[float] = (0, 0, 0), keeps_linear: bool = False):
        self.background, self.keeps_linear = background, keeps_linear
        self.messages: dict[str, None] = {}
        self.notes: dict[str, None] = {}

    def read(self, path: Path) -> np.ndarray:
        """[H, W, 3] of an image file, upright; uint8, uint16 or float32. Raises InputError."""
        return self.of(read_picture(path), path)

    def of(self, picture: Picture, path: Path) -> np.ndarray:
        """[H, W, 3] of a picture of the file `path`: of its type, or uint8 or float32 where colours are converted.
        Raises InputError."""
        pixels = picture.pixels
        check_finite(picture, path)
        channels = 1 if pixels.shape[2] < 3 else 3
        # A pixel tells what would be done: converting takes time, and 16 bits are kept where nothing is to be converted
        probe = in_srgb(pixels[:1, :1, :channels], picture)
        if self.keeps_linear and is_linear(picture):
            self.messages["linear, and kept so"] = None
        elif probe.description:
            colours = in_srgb(pixels[..., :channels], picture)
            self.messages |= {colours.description: None}
            self.notes |= {f"{path.name} {words}": None for words in colours.notes if not self.notes}
            converted = colours.pixels
            if pixels.shape[2] in (2, 4):
                shares = as_floats(pixels[..., -1:])
                alpha = shares if converted.dtype == np.float32 else np.rint(255 * shares).astype(np.uint8)
                converted = np.concatenate([converted, alpha], 2)
            return in_colour(converted, self.background)
        else:
            self.notes |= {f"{path.name} {words}": None for words in probe.notes if not self.notes}
        return in_colour(pixels, self.background)


def in_colour(pixels: np.ndarray, background: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """[H, W, 3] of pixels [H, W, C] of the same type: grey in three channels, alpha (2 or 4 channels) blended."""
    channels = pixels.shape[2]
    colour = pixels[..., :3] if channels >= 3 else np.repeat(pixels[..., :1], 3, 2)
    if channels not in (2, 4):
        return np.ascontiguousarray(colour)
    most = np.float32(1 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max)
    alpha = pixels[..., -1:] / most
    if bool((alpha == 1).all()):
        return np.ascontiguousarray(colour)
    blended = colour * alpha + (1 - alpha) * (np.asarray(background, np.float32) * most)
    return (blended if pixels.dtype == np.float32 else np.rint(blended)).astype(pixels.dtype)
