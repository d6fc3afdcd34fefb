"""Which mask belongs to which photograph of a capture. One that has none counts as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.masks import FOLDER, mask_named
from lightfield_gs.io.captures.photo_files import PhotoFiles, first_names
from lightfield_gs.io.captures.shot import Shot, Shots


def masks_for(
    found: Shots, shots: Sequence[Shot], folder: Path, masks: Path | None, alphas: Sequence[bool]
) -> list[Path | None]:
    """The mask's file of each shot: in the folder `masks` where that is given; else what the layout names; else in the
    capture's folder masks, or masks beside the images. Says which is used. alphas: which photographs have alpha.

    Raises InputError where a folder is given that has none of them.
    """
    if masks is None and any(shot.mask for shot in shots):
        paths, where = [shot.mask for shot in shots], f"mask_path of {found.source.name}"
    else:
        places = [masks] if masks else [folder / FOLDER, found.images.parent / FOLDER]
        paths, where = _in_folders([place for place in places if place.is_dir()], found.images.name, shots)
        if masks and not any(paths):
            raise InputError(
                f"{masks}: missing masks: expected {shots[0].name}.png or {PurePosixPath(shots[0].name).stem}.png, as "
                "the photographs are named"
            )
    if any(paths):
        without = [shot.name for shot, path in zip(shots, paths) if path is None]
        rest = f"; {len(without)} without one count as a whole: {first_names(without)}" if without else ""
        assume(f"what is white in the masks of {where} counts, what is black does not{rest}")
    if any(alphas):
        assume(f"what is opaque counts in {sum(alphas)} of {len(shots)} photographs that have alpha")
    return paths


def _in_folders(places: Sequence[Path], images: str, shots: Sequence[Shot]) -> tuple[list[Path | None], str]:
    """The masks in the first of these folders that has any, and its name."""
    for place in places:
        files = {name.lower(): path for name, path in PhotoFiles(place).paths.items()}
        names = [PurePosixPath(shot.name) for shot in shots]
        paths = [mask_named((name, images / name), files) for name in names]
        if any(paths):
            return paths, str(place)
    return [None] * len(shots), ""
