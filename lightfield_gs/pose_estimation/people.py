"""Masks of people, who move while a scene is photographed: neither posed by nor fitted to."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted
from lightfield_gs.io.atomic import atomic_folder
from lightfield_gs.io.images import apply_orientation, as_floats, read_picture
from lightfield_gs.photo.cut_out import rembg_mask

# Qin et al., "U^2-Net", 2020, trained on people; Apache-2.0. All thresholds are chosen by hand
_MODEL = "u2net_human_seg"
_PERSON = 77  # of 255, from which on a pixel may be a person's
_MARGIN = 0.01  # of the longer side by which people are widened: for hair, and for shadows at feet
_LEAST = 0.001  # fraction of a photograph below which there is nobody
_BACK = {6: 8, 8: 6}  # Exif orientations whose inverse is another one


def write_people_masks(paths: Mapping[str, Path], folder: Path, progress: Callable[[str], None]) -> bool:
    """Write a mask of each photograph, black on people, as NAME.png, and say how much they cover.

    Args:
        paths: photographs by their names.
        folder: a new folder.
        progress: called with a message.

    Returns:
        Whether there are people; if not, no folder is written.

    Raises:
        InputError: rembg or its weights are missing, or a photograph cannot be read.
    """
    progress(f"looks for people in {len(paths)} photographs")
    covered = []
    with atomic_folder(folder) as temporary:
        for name, path in paths.items():
            mask = _people_mask(path)
            covered.append(float((mask == 0).mean()))
            target = temporary / f"{name}.png"
            target.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask).save(target)
    there = [fraction for fraction in covered if fraction > 0]
    if not there:
        shutil.rmtree(folder)
        assume("there are no people in the photographs")
        return False
    words = counted(len(there), "photograph", len(paths), "show people, who do not count")
    assume(f"{words}: {np.mean(there):.0%} of their pixels; the masks are in {folder}")
    return True


def _people_mask(path: Path) -> np.ndarray:
    """Return the mask of a photograph as stored, uint8 [H,W]: 0 on people, 255 elsewhere."""
    picture = read_picture(path)  # upright: the network knows no others
    pixels = as_floats(picture.pixels)
    colours = np.repeat(pixels[..., :1], 3, 2) if pixels.shape[2] < 3 else pixels[..., :3]
    found = rembg_mask(
        np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8), _MODEL, "finds people", "paint masks, black on people"
    )
    people = found >= _PERSON
    mask = np.full(people.shape, 255, np.uint8)
    if people.mean() >= _LEAST:
        mask[ndimage.distance_transform_edt(~people) <= _MARGIN * max(people.shape)] = 0
    return np.ascontiguousarray(apply_orientation(mask, _BACK.get(picture.orientation, picture.orientation)))
