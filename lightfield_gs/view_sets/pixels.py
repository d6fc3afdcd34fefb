"""Pixels of views: conversion to sRGB, and comparison of neighbours, which tells the order of views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.io.images import Picture, as_floats, read_picture
from lightfield_gs.photo.colour import check_finite, is_linear, to_srgb

_SMALL_PX = 96  # longest side of compared thumbnails, so that fine texture does not count
_JUMP = 2.0  # times the difference of neighbours: more is a jump
_LEAST_DIFFERENCE = 0.2 / 255  # of neighbours: smaller ones carry no information


class ViewColours:
    """Reads views in three channels of sRGB, and records how it converted them.

    Attributes:
        background: red, green and blue in 0..1 behind images with alpha.
        keeps_linear: whether linear views stay linear, for a file of linear samples.
        messages: conversions of colours, each once (a dict for its order).
        notes: what may be wrong with the colours.
    """

    def __init__(self, background: Sequence[float] = (0, 0, 0), keeps_linear: bool = False):
        self.background, self.keeps_linear = background, keeps_linear
        self.messages: dict[str, None] = {}
        self.notes: dict[str, None] = {}

    def read(self, path: Path) -> np.ndarray:
        """Read an image file upright: [H, W, 3], uint8, uint16 or float32. Raises InputError."""
        return self.convert(read_picture(path), path)

    def convert(self, picture: Picture, path: Path) -> np.ndarray:
        """Convert an image of the file `path` to sRGB, over the background.

        Returns:
            [H, W, 3] of the image's type; uint8 or float32 where colours are converted.

        Raises:
            InputError: for pixels that are not finite.
        """
        pixels = picture.pixels
        check_finite(picture, path)
        channels = 1 if pixels.shape[2] < 3 else 3
        # One pixel tells the conversion: it takes time, and without one 16 bits are kept
        probe = to_srgb(pixels[:1, :1, :channels], picture)
        if self.keeps_linear and is_linear(picture):
            self.messages["linear, and kept so"] = None
        elif probe.description:
            colours = to_srgb(pixels[..., :channels], picture)
            self.messages |= {colours.description: None}
            self.notes |= {f"{path.name} {words}": None for words in colours.notes if not self.notes}
            converted = colours.pixels
            if pixels.shape[2] in (2, 4):
                opacity = as_floats(pixels[..., -1:])
                alpha = opacity if converted.dtype == np.float32 else np.rint(255 * opacity).astype(np.uint8)
                converted = np.concatenate([converted, alpha], 2)
            return in_colour(converted, self.background)
        else:
            self.notes |= {f"{path.name} {words}": None for words in probe.notes if not self.notes}
        return in_colour(pixels, self.background)


def in_colour(pixels: np.ndarray, background: Sequence[float] = (0, 0, 0)) -> np.ndarray:
    """Return pixels [H, W, C] as [H, W, 3] of the same type: grey repeated, alpha (2 or 4 channels) blended."""
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


def thumbnail(pixels: np.ndarray) -> np.ndarray:
    """Return the means of a view [H, W, 3] over squares, float32 [h, w, 3]."""
    height, width = pixels.shape[:2]
    each = max(1, -(-max(height, width) // _SMALL_PX))
    rows, columns = max(1, height // each), max(1, width // each)
    part = as_floats(pixels[: rows * each, : columns * each])
    return part.reshape(rows, min(each, height), columns, min(each, width), -1).mean((1, 3))


def _difference(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.abs(one - other).mean())


def rows_are_reversed(tile: Callable[[int, int], np.ndarray], columns: int, rows: int) -> bool:
    """Return whether views jump from row to row, and would not with the rows in the other order.

    Args:
        tile: returns the pixels of a row and a column; views go along a row, then on to the next.
        columns, rows: of the grid.
    """
    if columns < 2 or rows < 2:
        return False
    along, onwards, back = [], [], []
    ends: tuple[np.ndarray, np.ndarray] | None = None
    for row in range(rows):
        first, second, last = (thumbnail(tile(row, column)) for column in (0, 1, columns - 1))
        along.append(_difference(first, second))
        if ends is not None:
            onwards.append(_difference(ends[1], first))
            back.append(_difference(last, ends[0]))
        ends = first, last
    usual = max(float(np.mean(along)), _LEAST_DIFFERENCE)
    return min(onwards) > _JUMP * max(usual, *back)


def looks_like_rows(view: Callable[[int], np.ndarray], side: int) -> bool:
    """Return whether pictures jump after each `side` of them, as the rows of a grid of side x side cameras do."""
    start, before, end, then, after = pictures = [thumbnail(view(k)) for k in (0, side - 2, side - 1, side, side + 1)]
    if len({picture.shape for picture in pictures}) > 1:
        return False
    usual = max(_difference(before, end), _difference(then, after), _LEAST_DIFFERENCE)
    return _difference(end, then) > _JUMP * usual and _difference(start, then) < _difference(end, then) / _JUMP


def plays_back_and_forth(views: Sequence[np.ndarray]) -> bool:
    """Return whether the second half of these views [h, w, 3] repeats the first half backwards."""
    count = len(views)
    usual = max(float(np.mean([_difference(*pair) for pair in zip(views, views[1:])])), _LEAST_DIFFERENCE)
    for last in (count - 1, count):  # with the first frame again at the end, or not
        pairs = [(k, last - k) for k in range(last - count + 1, count // 2) if k < last - k]
        if len(pairs) > 1 and all(_difference(views[one], views[other]) * _JUMP < usual for one, other in pairs):
            return True
    return False
