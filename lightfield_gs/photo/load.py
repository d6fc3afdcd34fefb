"""Photos as RGBA: one object cut out, or the whole picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage

from lightfield_gs.base.checks import expect
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import MAP_ORIENTATIONS
from lightfield_gs.io.images import Picture, apply_orientation, as_floats, read_picture
from lightfield_gs.photo import foreground
from lightfield_gs.photo.colour import check_finite, to_srgb
from lightfield_gs.photo.image_filters import row_strips
from lightfield_gs.photo.plain import (
    Components,
    PlainCut,
    cut_from_plain_background,
    object_components,
    plain_background_mask,
)


@dataclass(frozen=True)
class CutOutConstants:
    """Plausibility of cut-outs.

    All are chosen by hand and not tuned on a data set; tests/photo has the pictures that they must tell apart.
    """

    # relative difference of aspect ratios of one picture: networks round sides to multiples of 14 or 32
    same_shape: float = 0.03
    least_object: float = 0.001  # fraction of the pixels of an object, at least
    opaque: float = 0.2  # alpha from which on a pixel counts for the crop, as in models/crop.py
    covers_all: float = 0.93  # fraction of the pixels from which on alpha has rounded corners or a frame, and no object
    all_of_rim: float = 0.98  # fraction of the rim from which on a mask may be inverted

    # Fractions of the area that an object encloses
    most_faded: float = 0.12  # of a pale body: beyond it the object itself is likely to be lost, and is refused
    most_holes: float = 0.6  # of holes: beyond it the object is also refused
    many_holes: float = 0.3  # of holes: beyond it a note says so
    # Things on a plain background that are a page: a thing is a fraction of all that stands out
    thing: float = 0.02
    things_of_page: int = 6
    most_of_page: float = 0.4  # fraction of the largest thing, at most
    # The same for letters, beside which a page may have a large picture
    letter: float = 0.0002
    letters_of_page: int = 50
    most_of_picture: float = 0.6
    few_levels: int = 16  # level, of 255, of the brightest pixel below which a mask numbers things


_C = CutOutConstants()


def has_same_shape(shape: Sequence[int], other: Sequence[int]) -> bool:
    """Return whether two sizes, height and width, fit the same picture, reduced or not."""
    ratio = shape[0] * other[1] / (shape[1] * other[0])
    return abs(ratio - 1) <= _C.same_shape


def turn_with_photo(
    name: str,
    values: np.ndarray,
    own_orientation: int,
    photo: tuple[int, int],
    orientation: int,
    choice: str | None = None,
    *,
    any_size: bool = False,
) -> tuple[np.ndarray, bool]:
    """Return the values of a map, upright as its photo is, and whether they had to be turned.

    The map is turned like the photo only where just the size before fits it. Where both sizes fit, `choice` decides.

    Args:
        name: Name of the map's file.
        values: [H, W, ...].
        own_orientation: The Exif orientation of the map's file: with one, or a photo without one, nothing is turned.
        photo: Height and width of the upright photo.
        orientation: The Exif orientation by which the photo was turned.
        choice: "stored", as the photo's file has its pixels, or "upright"; None: not known.
        any_size: Whether the map may have another size of the same shape.

    Raises:
        InputError: The choice is invalid, or needed and missing.
    """
    if choice is not None and choice not in MAP_ORIENTATIONS:
        raise InputError(f"map orientation: expected {' or '.join(MAP_ORIENTATIONS)}, got {choice!r}")
    if orientation not in range(2, 9) or own_orientation != 1:
        return values, False
    stored = photo[::-1] if orientation >= 5 else photo
    fits = has_same_shape if any_size else lambda shape, size: tuple(shape) == tuple(size)
    fits_stored, fits_upright = (fits(values.shape[:2], size) for size in (stored, photo))
    if choice is None and fits_stored and fits_upright:
        raise InputError(
            f"{name}: the photo is turned by its Exif orientation {orientation}, and the map may be of "
            "either; say which with map_orientation=: stored (as the photo's file has its pixels) or "
            "upright"
        )
    turned = choice == "stored" or choice is None and fits_stored
    return apply_orientation(values, orientation) if turned else values, turned


_INSTALL = "pip install 'lightfield-gs[photo]'"
# rembg's default model has changed between versions, once to weights without commercial use.
# U^2-Net: Qin et al., "U^2-Net: Going deeper with nested U-structure for salient object detection", 2020; Apache-2.0.
_MODEL = "u2net"


def rembg_alpha(rgb: np.ndarray) -> np.ndarray:
    """Return the alpha of the object that stands out in a photo, float32 [H, W] in 0..1.

    rembg downloads the weights (176 MB) at first use.

    Args:
        rgb: [H, W, 3] in 0..1.

    Raises:
        InputError: The package or its weights are missing.
    """
    try:
        import rembg
    except (ImportError, SystemExit) as error:  # without onnxruntime it exits
        raise InputError(
            f"rembg, which removes backgrounds, could not be imported ({error}): {_INSTALL}; or give a "
            "cut-out with mask=FILE"
        ) from None
    try:
        session = rembg.new_session(_MODEL)
        mask = rembg.remove(np.round(rgb * 255).astype(np.uint8), session=session, only_mask=True)
    except Exception as error:  # of the download, its file, or the inference: it may be anything
        raise InputError(
            f"rembg could not remove the background: run it again with a connection, if its weights {_MODEL} (176 MB, "
            "fetched at first use) are not on this machine; or give a cut-out with mask=FILE. It failed with: "
            f"{' '.join(str(error).split())[:200]}"
        ) from None
    return mask.astype(np.float32) / 255


__all__ = ["NoCutOut", "Photo", "load_photo", "cut_out_photo", "plain_background_mask"]
_STRIP_PIXELS = 1 << 19  # of colours and alpha that are joined at a time
_OTHER_CUT_OUTS = "give RGBA, a cut-out with mask=FILE, or remove_background=True (pip install 'lightfield-gs[photo]')"
_TO_SHOW_IT = (
    f": {_INSTALL}, which estimates its depth, to show it as a whole scene (depth=auto); or give its distances with "
    "depth=FILE; or, to show one object, give RGBA, a cut-out with mask=FILE, or remove_background=True"
)
_BY_ALPHA = "cut out by its alpha"


class NoCutOut(InputError):
    """Nothing tells which part of a photo is the object.

    Attributes:
        reason: Why, without the remedies.
        is_page: Whether the photo shows a page or a screen.
    """

    def __init__(self, reason: str, remedies: str, is_page: bool = False):
        super().__init__(f"{reason}{remedies}")
        self.reason, self.is_page = reason, is_page


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
    rgb, alpha = _colour_and_alpha(picture.pixels)
    colours = to_srgb(rgb, picture)
    photo = Photo(colours.pixels, picture.orientation, notes=[f"{path} {words}" for words in colours.notes])
    if picture.orientation in range(2, 9):
        photo.messages.append(f"turned by its Exif orientation {picture.orientation}")
    if mask is not None:
        alpha = _read_mask(mask, photo, map_orientation)
        photo.notes += _inversion_note(str(mask), alpha)
        empty = f"{mask}: nothing is cut out, the mask is (nearly) empty; give another"
        description = f"cut out by {Path(mask).name}"
    elif remove_background:
        alpha = rembg_alpha(as_floats(photo.pixels))
        empty = f"{path}: rembg found no object; give a cut-out with mask=FILE"
        description = "cut out by rembg"
    elif alpha is not None and (whole or (alpha > alpha.dtype.type(0.5 * _full_scale(alpha))).mean() < _C.covers_all):
        alpha = _as_alpha(alpha)
        empty = f"{path}: nothing is cut out, its alpha is (nearly) empty; give another photo or mask=FILE"
        description = _BY_ALPHA if alpha.min() < 1 else "whole picture"
        photo.notes += [] if whole else _inversion_note(f"{path}: its alpha", alpha)
    elif whole:
        alpha, empty, description = np.ones(rgb.shape[:2], np.float32), "", "whole picture"
    else:
        alpha, description = _cut_from_background(path, photo, alpha)
        if np.count_nonzero(alpha > 0.5) < _C.least_object * alpha.size:
            raise NoCutOut(f"{path}: its background looks plain and nothing stands out from it", f"; {_OTHER_CUT_OUTS}")
        empty = ""
    if np.count_nonzero(alpha > 0.5) < _C.least_object * alpha.size:
        raise InputError(empty)
    photo.messages.append(description if whole else description + _clear_specks(alpha))
    photo.messages += [colours.description] if colours.description else []
    photo.pixels = _join(photo.pixels, alpha)
    if clean_edges and foreground.clean_edges(photo.pixels[..., :3], alpha, description != _BY_ALPHA):
        photo.messages.append("edges cleaned of the old background (kept: clean_edges=False)")
    return photo


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


def _full_scale(values: np.ndarray) -> float:
    """Return the value that stands for 1 in an array of this type."""
    return 1.0 if values.dtype == np.float32 else float(np.iinfo(values.dtype).max)


def _as_alpha(alpha: np.ndarray) -> np.ndarray:
    """Return alpha of any type as float32 in 0..1."""
    return np.clip(as_floats(alpha), 0, 1)


def _join(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return RGBA of the type of rgb [H, W, 3]; alpha: [H, W] float32."""
    rgba = np.empty((*alpha.shape, 4), rgb.dtype)
    for top, bottom in row_strips(alpha.shape[0], alpha.shape[1], _STRIP_PIXELS):
        rgba[top:bottom, :, :3] = rgb[top:bottom]
        rgba[top:bottom, :, 3] = alpha[top:bottom] if rgb.dtype == np.float32 else np.rint(255 * alpha[top:bottom])
    return rgba


def _cut_from_background(path: str | Path, photo: Photo, alpha: np.ndarray | None) -> tuple[np.ndarray, str]:
    """Return alpha [H, W] of the object on a plain background, and a description.

    Args:
        path: For messages.
        photo: The photo; notes are appended.
        alpha: The photo's own, which leaves out next to nothing; None: it has none.
    """
    covered = None if alpha is None or alpha.min() >= _full_scale(alpha) else _as_alpha(alpha)
    cut = cut_from_plain_background(photo.pixels) if covered is None else _cut_within(photo.pixels, covered)
    if cut is None:
        if covered is None:
            raise NoCutOut(f"{path} has no cut-out and no plain background", _TO_SHOW_IT)
        photo.notes.append(
            f"{path}: its alpha covers {covered.mean():.1%} of it, and its background is not plain: all "
            f"of it is taken as one object, as flat as it may look; {_OTHER_CUT_OUTS}"
        )
        return covered, _BY_ALPHA
    if covered is None and _is_page(cut.alpha):
        raise NoCutOut(f"{path} shows many things on a plain background, as a page or a screen does", _TO_SHOW_IT, True)
    if cut.faded > _C.most_faded or cut.holes > _C.most_holes:
        raise NoCutOut(
            f"{path}: the object is hardly different from its plain background: "
            f"{cut.faded + cut.holes:.0%} of what its outline encloses would be gone",
            f"; {_OTHER_CUT_OUTS}",
        )
    if cut.holes > _C.many_holes:
        photo.notes.append(
            f"{path}: {cut.holes:.0%} of what the object encloses has the background's colour and is "
            f"taken for holes; where it is not, {_OTHER_CUT_OUTS}"
        )
    description = "cut out by its plain background"
    return cut.alpha, description if covered is None else f"{description} (its alpha covers {covered.mean():.1%})"


def _cut_within(rgb: np.ndarray, alpha: np.ndarray) -> PlainCut | None:
    """Return the object on the plain background of the pixels that alpha [H, W] covers, as a cut of the photo."""
    opaque = alpha > 0.5
    (box,) = ndimage.find_objects(opaque.view(np.uint8))
    inside, covered = rgb[box].copy(), opaque[box]
    edges = (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1])
    inside[~covered] = np.median(np.concatenate([inside[edge][covered[edge]] for edge in edges]), 0)
    cut = cut_from_plain_background(inside)
    if cut is not None:
        whole = np.zeros_like(alpha)
        whole[box] = np.minimum(cut.alpha, alpha[box])
        cut = replace(cut, alpha=whole)
    return cut


def _is_page(alpha: np.ndarray) -> bool:
    """Return whether a cut-out [H, W] has many things, none of which is the most of it: lines of text, or buttons."""
    components = Components(alpha >= _C.opaque, diagonal=True)
    masses = np.sort(components.sums(alpha))[::-1]
    if not len(masses):
        return False
    parts = masses / masses.sum()
    has_things = (parts >= _C.thing).sum() >= _C.things_of_page and parts[0] < _C.most_of_page
    has_letters = (parts >= _C.letter).sum() >= _C.letters_of_page and parts[0] < _C.most_of_picture
    return bool(has_things or has_letters or parts[0] < _C.thing)


def _inversion_note(name: str, alpha: np.ndarray) -> list[str]:
    """Return a note where a cut-out [H, W] covers the whole rim and leaves a hole inside, as if inverted."""
    rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    hole = float((alpha < 0.5).mean())
    if (rim > 0.5).mean() < _C.all_of_rim or hole < _C.least_object:
        return []
    return [
        f"{name} covers the whole rim of the picture and leaves a hole of {hole:.1%} of it inside: is it inverted? "
        "What is to be shown is bright or opaque"
    ]


def _clear_specks(alpha: np.ndarray) -> str:
    """Clear specks beside the object, in place; return a description of the rest."""
    kept, pieces, specks = object_components(alpha, _C.opaque)
    alpha[(alpha >= _C.opaque) & ~kept] = 0
    height, width = kept[ndimage.find_objects(kept.view(np.uint8))[0]].shape
    words = f", fills {kept.mean():.1%} of the picture, {width} x {height} pixels"
    words += f", in {pieces} pieces" if pieces > 1 else ""
    return words + (f" (specks beside it left out: {specks})" if specks else "")


def _colour_and_alpha(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return colours [H, W, 1 or 3] and alpha [H, W] or None of 1 (grey), 2 (grey, alpha), 3 or more channels."""
    colours = 1 if pixels.shape[2] < 3 else 3
    return pixels[..., :colours], pixels[..., colours] if pixels.shape[2] > colours else None


def _read_mask(path: str | Path, photo: Photo, map_orientation: str | None) -> np.ndarray:
    """Return alpha [H, W] float32 in 0..1 of a mask, upright as the photo is."""
    picture = read_picture(path)
    size = photo.pixels.shape[:2]
    pixels, turned = turn_with_photo(
        str(path), picture.pixels, picture.orientation, size, photo.orientation, map_orientation
    )
    photo.messages += [f"{Path(path).name} turned with it"] if turned else []
    if pixels.shape[:2] != size:
        raise InputError(
            f"{path}: expected a mask of the photo's size {size[1]} x {size[0]}, "
            f"got {pixels.shape[1]} x {pixels.shape[0]}"
        )
    colours, alpha = _colour_and_alpha(pixels)
    mask = as_floats(colours).mean(2) if alpha is None or alpha.min() >= _full_scale(alpha) else as_floats(alpha)
    if not np.isfinite(mask).all():
        raise InputError(f"{path} has pixels that are not finite; export it as 8- or 16-bit")
    if pixels.dtype != np.float32:
        levels = round(float(mask.max()) * _full_scale(pixels))
        if 1 < levels < _C.few_levels:
            raise InputError(
                f"{path}: expected a mask of 0 and {_full_scale(pixels):g}, or of 0 and 1; its brightest pixel "
                f"has {levels}, as where things are numbered; make the object white and the rest black"
            )
        if levels == 1:
            mask = mask * np.float32(_full_scale(pixels))
            photo.messages.append("a mask of 0 and 1")
    return np.array(np.clip(mask, 0, 1))
