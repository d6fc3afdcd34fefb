"""Masks beside the images of a set: white is object, or whatever is to be seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.photo_files import MASK_ENDINGS, is_hidden
from lightfield_gs.io.captures.views import IMAGE_SUFFIXES
from lightfield_gs.io.images import read_image

FOLDER = "masks"


def masks_beside(folder: Path, images: list[Path]) -> tuple[Path, ...] | None:
    """The files of folder/masks that belong to the images: named as these, or as these with .png added, as COLMAP has
    them. None where there is no such folder, or no image in it.

    images: below `folder`. Raises InputError when some have a mask and some have none.
    """
    root = folder / FOLDER
    known = {
        path.relative_to(root).as_posix().lower(): path
        for path in sorted(root.rglob("*"))
        if path.suffix.lower() in IMAGE_SUFFIXES and not is_hidden(path.name)
    }
    if not known:
        return None
    found = [_mask_of(folder.resolve(), image.resolve(), known) for image in images]
    missing = [image.name for image, mask in zip(images, found) if mask is None]
    if missing:
        names = f"{', '.join(missing[:3])}{' ...' if len(missing) > 3 else ''}"
        raise InputError(
            f"{root}: missing masks: none for {names} of {len(images)} images: expected "
            f"{missing[0]}.png or {Path(missing[0]).stem}.png; or another name for that folder"
        )
    return tuple(mask for mask in found if mask is not None)


def _mask_of(folder: Path, image: Path, known: dict[str, Path]) -> Path | None:
    """The mask of an image below `folder`, among those known by their lower-case paths below masks/."""
    relative = PurePath(image.relative_to(folder))
    inner = [PurePath(*relative.parts[1:])] if len(relative.parts) > 1 else []
    return mask_named((*inner, relative), known)


def mask_named(places: Sequence[PurePath], known: dict[str, Path]) -> Path | None:
    """The mask of an image at the first of these places that has one: named as the image, with .png or so added (as
    COLMAP does) or instead of its extension (nerfstudio), or with .mask.png (RealityScan) or _mask.png (Metashape).
    known: masks by their lower-case paths below their folder."""
    for place in places:
        if mask := _with_endings(place, ("", *MASK_ENDINGS), known):
            return mask
    return None


def mask_beside(image: PurePath, known: dict[str, Path]) -> Path | None:
    """The mask of an image in its own folder, which only an ending of its name tells from another image."""
    return _with_endings(image, MASK_ENDINGS, known)


def _with_endings(image: PurePath, endings: Sequence[str], known: dict[str, Path]) -> Path | None:
    """The picture that is named as an image, with or without its extension, and one of these endings."""
    for ending in endings:
        for name in (image, image.with_suffix("")):
            for suffix in IMAGE_SUFFIXES if ending else ("", *IMAGE_SUFFIXES):
                if mask := known.get(f"{name.as_posix()}{ending}{suffix}".lower()):
                    return mask
    return None


def read_mask(path: Path, width_px: int, height_px: int, any_size: bool = False) -> np.ndarray:
    """A mask as opacity, uint8 [H,W]: its alpha, or else its brightness; of values 0 and 1 alone, 1 is opaque.

    Its pixels as stored, like those of the image. Raises InputError for another size than the image's; any_size: then
    each pixel of the image has what the mask says at its middle.
    """
    pixels = read_image(path, as_stored=True, turn=False)
    if any_size:
        rows, columns = (
            (2 * np.arange(size) + 1) * stored // (2 * size)
            for size, stored in zip((height_px, width_px), pixels.shape[:2])
        )
        pixels = pixels[rows[:, None], columns]
    if pixels.shape[:2] != (height_px, width_px):
        raise InputError(
            f"{path}: expected a mask of the image's size {width_px} x {height_px}, got "
            f"{pixels.shape[1]} x {pixels.shape[0]}"
        )
    full = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    has_alpha = pixels.shape[2] in (2, 4) and pixels[..., -1].min() < full
    grey = pixels[..., -1] if has_alpha else pixels[..., : 1 if pixels.shape[2] < 3 else 3].mean(-1)
    if grey.max() <= 1:
        full = 1
    return np.rint(255 * np.clip(grey / full, 0, 1)).astype(np.uint8)
