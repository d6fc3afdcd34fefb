"""Photos as RGBA: one object cut out, or the whole picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import Picture, as_floats, read_picture
from lightfield_gs.photo import foreground
from lightfield_gs.photo.colour import check_finite, to_srgb
from lightfield_gs.photo.cut_out import (
    BY_ALPHA,
    as_alpha,
    check_no_framed_page,
    clear_specks,
    colour_and_alpha,
    covers_all,
    cut_from_background,
    inversion_note,
    is_empty,
    read_mask,
    rembg_alpha,
)
from lightfield_gs.photo.image_filters import row_strips
from lightfield_gs.photo.photo import Photo

_STRIP_PIXELS = 1 << 19  # of colours and alpha that are joined at a time


def load_photo(
    path: str | Path,
    mask: str | Path | None = None,
    *,
    remove_background: bool = False,
    whole: bool = False,
    map_orientation: str | None = None,
    clean_edges: bool = True,
) -> np.ndarray:
    """Load a photo as float32 RGBA [H, W, 4] in 0..1, sRGB, upright, alpha straight: 1 on the object, 0 beside it.

    Without a mask the photo's own alpha is the cut-out, or else the object on a plain background is. Specks beside the
    object are left out. Alpha that covers nearly everything does not count as a cut-out. An object that hardly differs
    from its plain background is refused.

    Args:
        path: The photo.
        mask: The cut-out, an image of the photo's size: its alpha, else its brightness.
        remove_background: Whether the package rembg finds the object.
        whole: Whether the whole picture is the object.
        map_orientation: "stored" or "upright": the orientation of a mask whose size does not tell.
        clean_edges: Whether partly transparent pixels lose the colour of the old background, where they have it.

    Raises:
        InputError: There is no cut-out, or nothing in it.
    """
    picture = read_picture(path)
    options: dict[str, Any] = dict(remove_background=remove_background, whole=whole, map_orientation=map_orientation)
    options["clean_edges"] = clean_edges
    return cut_out_photo(path, picture, mask, **options).floats()


def cut_out_photo(
    path: str | Path,
    picture: Picture,
    mask: str | Path | None = None,
    *,
    remove_background: bool = False,
    whole: bool = False,
    map_orientation: str | None = None,
    clean_edges: bool = True,
) -> Photo:
    """Cut the object out of a picture.

    Args:
        path: Path of the picture, for messages.
        picture: As read_picture returns it.
        mask: See load_photo.
        remove_background: See load_photo.
        whole: See load_photo.
        map_orientation: See load_photo.
        clean_edges: See load_photo.

    Raises:
        InputError: As load_photo.
    """
    expect("remove_background", remove_background, bool)
    expect("whole", whole, bool)
    expect("clean_edges", clean_edges, bool)
    if mask is not None and remove_background:
        raise InputError("mask= and remove_background= are two ways to the same cut-out; leave out one of them")
    check_finite(picture, path)
    rgb, alpha = colour_and_alpha(picture.pixels)
    colours = to_srgb(rgb, picture)
    photo = Photo(colours.pixels, picture.orientation, notes=[f"{path} {words}" for words in colours.notes])
    if picture.orientation in range(2, 9):
        photo.messages.append(f"turned by its Exif orientation {picture.orientation}")
    if mask is not None:
        alpha = read_mask(mask, photo, map_orientation)
        photo.notes += inversion_note(str(mask), alpha)
        empty = f"{mask}: nothing is cut out, the mask is (nearly) empty; give another"
        description = f"cut out by {Path(mask).name}"
    elif remove_background:
        alpha = rembg_alpha(as_floats(photo.pixels))
        empty = f"{path}: rembg found no object; give a cut-out with mask=FILE"
        description = "cut out by rembg"
    elif alpha is not None and (whole or not covers_all(alpha)):
        alpha = as_alpha(alpha)
        if not whole:
            check_no_framed_page(path, photo.pixels, alpha)
        empty = f"{path}: nothing is cut out, its alpha is (nearly) empty; give another photo or mask=FILE"
        description = BY_ALPHA if alpha.min() < 1 else "whole picture"
        photo.notes += [] if whole else inversion_note(f"{path}: its alpha", alpha)
    elif whole:
        alpha, empty, description = np.ones(rgb.shape[:2], np.float32), "", "whole picture"
    else:
        (alpha, description), empty = cut_from_background(path, photo, alpha), ""
    if is_empty(alpha):
        raise InputError(empty)
    photo.messages.append(description if whole else description + clear_specks(alpha))
    photo.messages += [colours.description] if colours.description else []
    photo.pixels = _join(photo.pixels, alpha)
    if clean_edges and foreground.clean_edges(photo.pixels[..., :3], alpha, description != BY_ALPHA):
        photo.messages.append("edges cleaned of the old background (kept: clean_edges=False)")
    return photo


def _join(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return RGBA of the type of rgb [H, W, 3]; alpha: [H, W] float32."""
    rgba = np.empty((*alpha.shape, 4), rgb.dtype)
    for top, bottom in row_strips(alpha.shape[0], alpha.shape[1], _STRIP_PIXELS):
        rgba[top:bottom, :, :3] = rgb[top:bottom]
        rgba[top:bottom, :, 3] = alpha[top:bottom] if rgb.dtype == np.float32 else np.rint(255 * alpha[top:bottom])
    return rgba
