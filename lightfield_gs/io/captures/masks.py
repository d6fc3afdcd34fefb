"""Which mask belongs to which image: by names, in data sets of objects and in captures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath, PurePosixPath

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.captures.photo_files import (
    IMAGE_SUFFIXES,
    MASK_ENDINGS,
    MASK_FOLDERS,
    PhotoFiles,
    first_names,
    is_hidden,
)
from lightfield_gs.io.captures.photograph import Shot, Shots

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


def masks_for(
    found: Shots, shots: Sequence[Shot], folder: Path, masks: Path | None, alphas: Sequence[bool]
) -> list[Path | None]:
    """The mask's file of each shot: in the folder `masks` where that is given; else what the layout names; else in a
    folder masks or mask of the capture, beside or below the images, or beside the photographs themselves. Says which
    is used, and which belong to no photograph. alphas: which photographs have alpha.

    Raises InputError where a folder is given that has none of them.
    """
    if masks is None and any(shot.mask for shot in shots):
        paths, where = [shot.mask for shot in shots], f"mask_path of {found.source.name}"
    else:
        roots = (folder, found.images.parent, found.images)
        places = [masks] if masks else [place for root in roots for place in _mask_folders(root)]
        paths, where = _in_folders([place for place in places if place.is_dir()], found.images, shots)
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


def _mask_folders(root: Path) -> list[Path]:
    """The folders of masks in a folder, in any case, in the order of MASK_FOLDERS."""
    with reading(root):
        found = sorted(path for path in root.iterdir() if path.name.lower() in MASK_FOLDERS)
    return sorted(found, key=lambda path: MASK_FOLDERS.index(path.name.lower()))


def _in_folders(places: Sequence[Path], images: Path, shots: Sequence[Shot]) -> tuple[list[Path | None], str]:
    """The masks in the first of these folders that has any, or else beside the photographs; and where."""
    beside = PhotoFiles(images)
    posed = [PurePosixPath(shot.name) for shot in shots]
    others = [PurePosixPath(name) for name in beside.photographs]  # which may have masks without being posed
    for place in dict.fromkeys(places):
        known = {name.lower(): path for name, path in PhotoFiles(place).paths.items()}
        paths = [mask_named(_places(name, posed, images), known) for name in posed]
        owned = {mask_named(_places(name, others, images), known) for name in others}.union(paths)
        _say_unowned(place, [name for name, path in known.items() if path not in owned], len(known), shots[0].name)
        if any(paths):
            return paths, str(place)
    known = {name.lower(): path for name, path in beside.paths.items()}
    return [mask_beside(name, known) for name in posed], f"{images}, beside the photographs,"


def _places(name: PurePosixPath, names: Sequence[PurePosixPath], images: Path) -> list[PurePosixPath]:
    """Where the mask of a photograph may be in a folder of masks; one that all `names` are in may be left out."""
    inner = [PurePosixPath(*name.parts[1:])] if len({other.parts[0] for other in names}) == 1 < len(name.parts) else []
    return [name, images.name / name, *inner]


def _say_unowned(place: Path, names: Sequence[str], count: int, example: str) -> None:
    """Says which pictures of a folder of masks belong to no photograph."""
    if not names:
        return
    which = (
        "none of which belongs to a"
        if len(names) == count
        else f"{len(names)} of which belong{'s' * (len(names) == 1)} to no"
    )
    assume(
        f"{place} holds {count} pictures, {which} photograph: {first_names(names)}; the mask of {example} is "
        f"{example}.png, {PurePosixPath(example).stem}.png, or one with .mask.png or _mask.png"
    )
