"""The background of pictures that have neither alpha nor mask: decided once for all views of an object.

Renders have a background of exactly one colour. A pixel of any other colour is object, however pale, except in the
faint thin ring that resizing leaves round an outline. Mixed pixels of the outline are parted into object and
background. Photographs before a plain wall, and pictures in lossy formats, have a background of about one colour. The
object stands out from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from lightfield_gs.photo.plain import Components, find_full_squares

Choice = Literal["auto", "white", "black", "none"]
CHOICES = get_args(Choice)
_COLOURS = {"white": (255, 255, 255), "black": (0, 0, 0)}
_CORNER_SHARE = 0.5  # of the corners of all views, more than which must have the colour: objects leave corners last
_LOSSY_LEVELS = 8  # how far a lossy format moves a plain colour beside an outline
_SIMILAR_LEVELS, _EXACT_FRACTION = 8, 0.5  # levels round the colour; the fraction of the pixels within that have it
_RING_LEVELS = 6  # how far the ringing of a resized render strays from its background
_HOLE_SIDE = 0.025  # of the shorter side: patches of the background inside the object that are smaller are highlights
_HOLE_EDGE_LEVELS = 24  # step of colour round a hole; a highlight that is clipped to the background's colour fades
_PARTED_LEVELS = 64  # an outline is parted where the object's colour is at least so far from the background's
# Thresholds for plain backgrounds, the same as in lightfield_gs/photo/plain.py, for colours 0..1.
_PLAIN_SPREAD, _PLAIN_FRACTION, _NEAR, _FAR, _SAME = 0.04, 0.9, 0.06, 0.14, 0.02
_DRIFT = 0.2  # of a plain background's colour from view to view, by exposure: a border further off is object
_PLAIN_VIEWS = 0.75  # of an object's views: fewer are chance, as before the walls of a room


@dataclass(frozen=True)
class Border:
    """Pixels uint8 [N,3] at the border of a view, its four corners [4,3], and whether its format is lossy."""

    pixels: np.ndarray
    corners: np.ndarray
    lossy: bool


@dataclass(frozen=True)
class Background:
    """A background of about one colour.

    Attributes:
        colour: 0..255.
        exact: Whether the background has exactly this colour.
    """

    colour: tuple[int, int, int]
    exact: bool

    def cut(self, rgb: np.ndarray) -> np.ndarray:
        """The object of a view [H,W,3], premultiplied uint8 [H,W,4]."""
        if not self.exact:
            return premultiplied(rgb, _plain_alpha(rgb, self.colour))
        frame = premultiplied(rgb, _exact_alpha(rgb, self.colour))
        _part_outline(frame, np.array(self.colour, np.float32))
        return frame

    def __str__(self) -> str:
        return f"{'exactly' if self.exact else 'about'} #{bytes(self.colour).hex()}"


def premultiplied(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Colours uint8 [H,W,3] times opacity uint8 [H,W], and that: [H,W,4]."""
    colours = (rgb.astype(np.uint16) * alpha[..., None] + 127) // 255
    return np.concatenate([colours.astype(np.uint8), alpha[..., None]], axis=-1)


def read_border(rgb: np.ndarray, lossy: bool) -> Border:
    """Return the pixels of a view [H,W,3] that find_background examines."""
    return Border(rgb[_at_border(rgb)], rgb[[0, 0, -1, -1], [0, -1, 0, -1]], lossy)


def _at_border(rgb: np.ndarray) -> np.ndarray:
    thick = max(1, round(0.02 * min(rgb.shape[:2])))
    border = np.ones(rgb.shape[:2], bool)
    border[thick:-thick, thick:-thick] = False
    return border


def find_background(views: list[Border], choice: Choice = "auto") -> Background | None:
    """The background of an object's views; None: there is none, the whole pictures are the subject."""
    if choice == "none" or not views:
        return None
    lossy = any(view.lossy for view in views)
    if choice in _COLOURS:
        return Background(_COLOURS[choice], not lossy)
    return _one_colour(views, lossy) or _plain_colour(views)


def _one_colour(views: list[Border], lossy: bool) -> Background | None:
    """A background of one colour (in a lossy format nearly so), which most corners have; close-ups hide the rest."""
    corners, levels = np.concatenate([view.corners for view in views]).astype(int), _LOSSY_LEVELS if lossy else 0
    colours, counts = np.unique(corners, axis=0, return_counts=True)
    colour = colours[counts.argmax()]
    for usual in _COLOURS.values() if lossy else ():
        colour = np.array(usual) if (np.abs(colour - usual) <= levels).all() else colour
    if (np.abs(corners - colour).max(-1) <= levels).mean() <= _CORNER_SHARE:
        return None
    off = np.abs(np.concatenate([view.pixels for view in views]).astype(int) - colour).max(-1)
    if (off <= levels).sum() < _EXACT_FRACTION * (off <= levels + _SIMILAR_LEVELS).sum():
        return None
    return Background(tuple(int(value) for value in colour), not lossy)


def _plain_colour(views: list[Border]) -> Background | None:
    """The middle of the colours before which the views were taken, where nearly all are plain in themselves."""
    found = [colour for view in views if (colour := _own_plain_colour(view.pixels)) is not None]
    if len(found) < _PLAIN_VIEWS * len(views):
        return None
    return Background(tuple(int(value) for value in np.rint(255 * np.median(found, 0))), False)


def _own_plain_colour(border: np.ndarray) -> np.ndarray | None:
    """The colour 0..1 of a border [N,3] of about one colour."""
    border = border / np.float32(255)
    near = np.linalg.norm(border - np.median(border, 0), axis=1) < _NEAR + _PLAIN_SPREAD
    plain = near.mean() >= _PLAIN_FRACTION and border[near].std(0).max() <= _PLAIN_SPREAD
    return border[near].mean(0) if plain else None


def _plain_alpha(rgb: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Alpha that rises with the distance from the background's colour, which drifts a little from view to view."""
    border, shared = _at_border(rgb), np.array(colour) / 255
    own = _own_plain_colour(rgb[border])
    drifted = own is not None and np.linalg.norm(own - shared) < _DRIFT
    distance = np.linalg.norm(rgb / np.float32(255) - (own if drifted else shared), axis=2)
    components = Components(distance < _FAR, diagonal=False)
    outside = components.mask(components.touching(border | find_full_squares(distance < _SAME, _hole_side(rgb))))
    return np.rint(255 * np.where(outside, np.clip((distance - _NEAR) / (_FAR - _NEAR), 0, 1), 1)).astype(np.uint8)


def _exact_alpha(rgb: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """255 where a pixel differs from the background, or is enclosed by such and no hole."""
    off = np.abs(rgb.astype(int) - colour).max(-1)
    empty = (off == 0) | (off <= _RING_LEVELS) & ~_opened(off > 0)
    frame = np.ones(off.shape, bool)
    frame[1:-1, 1:-1] = False
    components = Components(empty, diagonal=False)
    outside = components.mask(components.touching(frame))
    return np.where(outside | _holes(off, outside, _hole_side(rgb)), 0, 255).astype(np.uint8)


def _part_outline(frame: np.ndarray, background: np.ndarray) -> None:
    """Give the outline of premultiplied [H,W,4], opaque or empty so far, the alpha of its mix with the background.

    The object's own colour is the colour of a pixel inside. Of the near pixels it takes the most similar one, so that
    pale parts beside dark parts stay. Over the background the picture is as before.
    """
    inside = frame[..., 3] > 0
    core = inside & ~_grown(~inside, 1)
    rows, columns = np.nonzero(inside & ~core)
    colours = frame[rows, columns, :3].astype(np.float32)
    own, nearest = colours.copy(), np.full(len(rows), np.inf)
    for down, right in np.ndindex(5, 5):
        y, x = np.clip(rows + down - 2, 0, len(core) - 1), np.clip(columns + right - 2, 0, core.shape[1] - 1)
        distance = np.where(core[y, x], np.linalg.norm(frame[y, x, :3] - colours, axis=1), np.inf)
        own = np.where((distance < nearest)[:, None], frame[y, x, :3], own)
        nearest = np.minimum(nearest, distance)
    step, size = own - background, np.linalg.norm(own - background, axis=1)
    fraction = ((colours - background) * step).sum(1) / np.maximum(size, 1) ** 2
    alpha = np.where(size > _PARTED_LEVELS, np.clip(fraction, 1 / 255, 1), 1)[:, None]
    mixed = np.clip(colours - (1 - alpha) * background, 0, 255 * alpha)
    frame[rows, columns] = np.rint(np.concatenate([mixed, 255 * alpha], 1)).astype(np.uint8)


def _hole_side(rgb: np.ndarray) -> int:
    return max(3, round(_HOLE_SIDE * min(rgb.shape[:2])))


def _holes(off: np.ndarray, outside: np.ndarray, side: int) -> np.ndarray:
    """Return enclosed patches [H,W] of the background's colour, as large as a square of `side` pixels, with a sharp
    edge.

    Args:
        off: Difference of each pixel from the background, in levels.
    """
    enclosed = (off == 0) & ~outside
    components = Components(enclosed, diagonal=False)
    open_ = components.touching(find_full_squares(enclosed, side))
    for piece in np.flatnonzero(open_):
        patch = components.mask(np.arange(components.count) == piece)
        edge = _grown(patch, 2) & ~patch
        open_[piece] = np.median(off[edge]) > _HOLE_EDGE_LEVELS
    return components.mask(open_)


def _opened(flags: np.ndarray) -> np.ndarray:
    """Remove parts of flags [H,W] thinner than 3 pixels; flags continue beyond the edges."""
    padded = np.pad(flags, 1, mode="edge")
    return _grown(~_grown(~padded, 1), 1)[1:-1, 1:-1]


def _grown(flags: np.ndarray, pixels: int) -> np.ndarray:
    """Flags [H,W], set wherever one is set within so many pixels along both axes."""
    for axis in (0, 1):
        padded = np.pad(flags, [(pixels, pixels) if axis == other else (0, 0) for other in (0, 1)])
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * pixels + 1, axis)
        flags = windows.any(-1)
    return flags
