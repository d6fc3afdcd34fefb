"""Training images as premultiplied RGBA of the object."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from lightfield_gs.errors import InputError
from lightfield_gs.io.images import read_image
from lightfield_gs.io.photo import plain_background_mask
from training.data.views import ObjectViews


def read_premultiplied(path: Path, width_px: int, height_px: int) -> np.ndarray:
    """Read a view as uint8 [H,W,4], colours multiplied by alpha.

    An image without transparency gets its mask from its background when that has one plain colour; otherwise the whole
    picture is the subject, as in the rooms of the original renderer. Raises InputError for unreadable images, images
    whose size is not the intrinsics' width_px x height_px, and images that show no object.
    """
    try:
        pixels = read_image(path, as_stored=True)
    except InputError as error:
        raise InputError(f"unreadable image: {error}") from None
    if pixels.dtype != np.uint8 or pixels.shape[2] not in (3, 4):
        raise InputError(f"{path}: expected 8-bit RGB or RGBA, got {pixels.shape[2]} channels of {pixels.dtype}")
    if pixels.shape[:2] != (height_px, width_px):
        raise InputError(f"{path}: bad intrinsics: they say {width_px} x {height_px} pixels, "
                         f"the image has {pixels.shape[1]} x {pixels.shape[0]}")
    alpha = _alpha(pixels)
    if not alpha.any():
        raise InputError(f"{path}: empty image: expected an object, every pixel is transparent")
    colours = (pixels[..., :3].astype(np.uint16) * alpha[..., None] + 127) // 255
    return np.concatenate([colours.astype(np.uint8), alpha[..., None]], axis=-1)


def _alpha(pixels: np.ndarray) -> np.ndarray:
    """The object's opacity, uint8 [H,W], of an image [H,W,3 or 4]."""
    if pixels.shape[2] == 4 and pixels[..., 3].min() < 255:
        return pixels[..., 3]
    mask = plain_background_mask(pixels[..., :3].astype(np.float32) / 255)
    return np.full(pixels.shape[:2], 255, np.uint8) if mask is None else np.rint(255 * mask).astype(np.uint8)


def read_view(views: ObjectViews, index: int) -> np.ndarray:
    """One view of an object as premultiplied uint8 [H,W,4]."""
    return read_premultiplied(views.image_paths[index], views.width_px, views.height_px)
