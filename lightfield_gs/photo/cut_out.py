"""Which part of a photo is the object: by a plain background, a mask, or the package rembg."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import as_floats, read_picture
from lightfield_gs.photo.map_orientation import turn_with_photo
from lightfield_gs.photo.photo import Photo
from lightfield_gs.photo.plain import Components, PlainCut, cut_from_plain_background, object_components


@dataclass(frozen=True)
class CutOutConstants:
    """Plausibility of cut-outs.

    All are chosen by hand and not tuned on a data set; tests/photo has the pictures that they must tell apart.
    """

    least_object: float = 0.001  # fraction of the pixels of an object, at least
    opaque: float = 0.2  # alpha from which on a pixel counts for the crop, as in models/crop.py
    covers_all: float = 0.93  # fraction of the pixels from which on alpha has rounded corners or a frame, and no object
    rectangle: float = 0.98  # fraction of its box that an object fills from which on it may be a window or a page
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
    pixels = np.round(rgb * 255).astype(np.uint8)
    return rembg_mask(pixels, _MODEL, "removes backgrounds", "give a cut-out with mask=FILE").astype(np.float32) / 255


def rembg_mask(pixels: np.ndarray, model: str, does: str, remedy: str) -> np.ndarray:
    """Return how much of each pixel one of rembg's networks takes as its object, uint8 [H, W].

    rembg downloads the weights (176 MB) at first use.

    Args:
        pixels: uint8 [H, W, 3].
        model: rembg's name of the network.
        does: The purpose of rembg, for the message.
        remedy: Another way, for the message.

    Raises:
        InputError: The package or its weights are missing.
    """
    try:
        import rembg
    except (ImportError, SystemExit) as error:  # without onnxruntime it exits
        raise InputError(f"rembg, which {does}, could not be imported ({error}): {_INSTALL}; or {remedy}") from None
    try:
        return np.asarray(rembg.remove(pixels, session=_session(rembg, model), only_mask=True))
    except Exception as error:  # of the download, its file, or the inference: it may be anything
        raise InputError(
            f"rembg, which {does}, failed: run it again with a connection, if its weights {model} (176 MB, fetched at "
            f"first use) are not on this machine; or {remedy}. It failed with: {' '.join(str(error).split())[:200]}"
        ) from None


@functools.lru_cache(maxsize=1)
def _session(rembg: Any, model: str) -> Any:
    """Return a network of rembg, whose start takes longer than a picture: films and live pictures use it again."""
    return rembg.new_session(model)


_OTHER_CUT_OUTS = "give RGBA, a cut-out with mask=FILE, or remove_background=True (pip install 'lightfield-gs[photo]')"
_TO_SHOW_IT = (
    f": {_INSTALL}, which estimates its depth, to show it as a whole scene (depth=auto); or give its distances with "
    "depth=FILE; or, to show one object, give RGBA, a cut-out with mask=FILE, or remove_background=True"
)
BY_ALPHA = "cut out by its alpha"


class NoCutOut(InputError):
    """Nothing tells which part of a photo is the object.

    Attributes:
        reason: Why, without the remedies.
        is_page: Whether the photo shows a page or a screen.
    """

    def __init__(self, reason: str, remedies: str, is_page: bool = False):
        super().__init__(f"{reason}{remedies}")
        self.reason, self.is_page = reason, is_page


def cut_from_background(path: str | Path, photo: Photo, alpha: np.ndarray | None) -> tuple[np.ndarray, str]:
    """Return alpha [H, W] of the object on a plain background, and a description. Raises NoCutOut.

    Args:
        path: For messages.
        photo: The photo; notes are appended.
        alpha: The photo's own, which leaves out next to nothing; None: it has none.
    """
    covered = None if alpha is None or alpha.min() >= full_scale(alpha) else as_alpha(alpha)
    cut = cut_from_plain_background(photo.pixels) if covered is None else _cut_within(photo.pixels, covered)
    if cut is None:
        if covered is None:
            raise NoCutOut(f"{path} has no cut-out and no plain background", _TO_SHOW_IT)
        photo.notes.append(
            f"{path}: its alpha covers {covered.mean():.1%} of it, and its background is not plain: all "
            f"of it is taken as one object, as flat as it may look; {_OTHER_CUT_OUTS}"
        )
        return covered, BY_ALPHA
    if covered is None and _is_page(cut.alpha):
        raise _page(path)
    check_no_framed_page(path, photo.pixels, cut.alpha)
    if is_empty(cut.alpha):
        raise NoCutOut(f"{path}: its background looks plain and nothing stands out from it", f"; {_OTHER_CUT_OUTS}")
    if cut.faded > _C.most_faded or cut.holes > _C.most_holes:
        raise NoCutOut(
            f"{path}: the object is hardly different from its plain background: "
            f"{cut.faded + cut.holes:.0%} of what its outline encloses would be gone",
            _TO_SHOW_IT,
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


def is_empty(alpha: np.ndarray) -> bool:
    """Return whether a cut-out [H, W] leaves next to nothing."""
    return int(np.count_nonzero(alpha > 0.5)) < _C.least_object * alpha.size


def covers_all(alpha: np.ndarray) -> bool:
    """Return whether a photo's own alpha [H, W], of any type, has rounded corners or a frame, and no object."""
    return bool((alpha > alpha.dtype.type(0.5 * full_scale(alpha))).mean() >= _C.covers_all)


def check_no_framed_page(path: str | Path, rgb: np.ndarray, alpha: np.ndarray) -> None:
    """Raise NoCutOut where a cut-out [H, W] is a rectangle, as a window with its shadow is, and shows a page."""
    opaque = alpha > 0.5
    if is_empty(alpha) or opaque[ndimage.find_objects(opaque.view(np.uint8))[0]].mean() < _C.rectangle:
        return
    inside = _cut_within(rgb, alpha)
    if inside is not None and _is_page(inside.alpha):
        raise _page(path)


def _page(path: str | Path) -> NoCutOut:
    return NoCutOut(f"{path} shows many things on a plain background, as a page or a screen does", _TO_SHOW_IT, True)


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


def inversion_note(name: str, alpha: np.ndarray) -> list[str]:
    """Return a note where a cut-out [H, W] covers the whole rim and leaves a hole inside, as if inverted."""
    rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    hole = float((alpha < 0.5).mean())
    if (rim > 0.5).mean() < _C.all_of_rim or hole < _C.least_object:
        return []
    return [
        f"{name} covers the whole rim of the picture and leaves a hole of {hole:.1%} of it inside: is it inverted? "
        "What is to be shown is bright or opaque"
    ]


def clear_specks(alpha: np.ndarray) -> str:
    """Clear specks beside the object, in place; return a description of the rest."""
    kept, pieces, specks = object_components(alpha, _C.opaque)
    alpha[(alpha >= _C.opaque) & ~kept] = 0
    height, width = kept[ndimage.find_objects(kept.view(np.uint8))[0]].shape
    words = f", fills {kept.mean():.1%} of the picture, {width} x {height} pixels"
    words += f", in {pieces} pieces" if pieces > 1 else ""
    return words + (f" (specks beside it left out: {specks})" if specks else "")


def full_scale(values: np.ndarray) -> float:
    """Return the value that stands for 1 in an array of this type."""
    return 1.0 if values.dtype == np.float32 else float(np.iinfo(values.dtype).max)


def as_alpha(alpha: np.ndarray) -> np.ndarray:
    """Return alpha of any type as float32 in 0..1."""
    return np.clip(as_floats(alpha), 0, 1)


def colour_and_alpha(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return colours [H, W, 1 or 3] and alpha [H, W] or None of 1 (grey), 2 (grey, alpha), 3 or more channels."""
    colours = 1 if pixels.shape[2] < 3 else 3
    return pixels[..., :colours], pixels[..., colours] if pixels.shape[2] > colours else None


def read_mask(path: str | Path, photo: Photo, map_orientation: str | None) -> np.ndarray:
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
    colours, alpha = colour_and_alpha(pixels)
    mask = as_floats(colours).mean(2) if alpha is None or alpha.min() >= full_scale(alpha) else as_floats(alpha)
    if not np.isfinite(mask).all():
        raise InputError(f"{path} has pixels that are not finite; export it as 8- or 16-bit")
    if pixels.dtype != np.float32:
        levels = round(float(mask.max()) * full_scale(pixels))
        if 1 < levels < _C.few_levels:
            raise InputError(
                f"{path}: expected a mask of 0 and {full_scale(pixels):g}, or of 0 and 1; its brightest pixel "
                f"has {levels}, as where things are numbered; make the object white and the rest black"
            )
        if levels == 1:
            mask = mask * np.float32(full_scale(pixels))
            photo.messages.append("a mask of 0 and 1")
    return np.array(np.clip(mask, 0, 1))
