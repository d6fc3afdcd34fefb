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
from lightfield_gs.io.captures.photograph import PosedCapture, PosedPhotograph

FOLDER = "masks"


def find_object_masks(folder: Path, images: list[Path]) -> tuple[Path, ...] | None:
    """Find the masks of a data set's images in folder/masks.

    A mask is named as its image, or, as in COLMAP, with .png added.

    Args:
        folder: the data set.
        images: image files below `folder`.

    Returns:
        A file for each image; None where there is no such folder, or no image in it.

    Raises:
        InputError: where some images have a mask and some have none.
    """
    root = folder / FOLDER
    known = {
        path.relative_to(root).as_posix().lower(): path
        for path in sorted(root.rglob("*"))
        if path.suffix.lower() in IMAGE_SUFFIXES and not is_hidden(path.name)
    }
    if not known:
        return None
    found = [_find_object_mask(folder.resolve(), image.resolve(), known) for image in images]
    missing = [image.name for image, mask in zip(images, found) if mask is None]
    if missing:
        names = f"{', '.join(missing[:3])}{' ...' if len(missing) > 3 else ''}"
        raise InputError(
            f"{root}: missing masks: none for {names} of {len(images)} images: expected "
            f"{missing[0]}.png or {Path(missing[0]).stem}.png; or another name for that folder"
        )
    return tuple(mask for mask in found if mask is not None)


def _find_object_mask(folder: Path, image: Path, known: dict[str, Path]) -> Path | None:
    """Return the mask of an image below `folder` among masks by their lower-case paths below masks/."""
    relative = PurePath(image.relative_to(folder))
    inner = [PurePath(*relative.parts[1:])] if len(relative.parts) > 1 else []
    return _find_named_mask((*inner, relative), known)


def _find_named_mask(candidates: Sequence[PurePath], known: dict[str, Path]) -> Path | None:
    """Return the mask of an image at the first of these paths that has one.

    It has the image's name, with .png or so added (COLMAP) or in place of its extension (nerfstudio). RealityScan adds
    .mask.png, Metashape _mask.png.

    Args:
        candidates: paths of the image below the folder of masks.
        known: masks by their lower-case paths below their folder.
    """
    for candidate in candidates:
        if mask := _find_with_endings(candidate, ("", *MASK_ENDINGS), known):
            return mask
    return None


def _find_mask_beside(image: PurePath, known: dict[str, Path]) -> Path | None:
    """Return the mask of an image in its own folder, where only the ending of its name tells it from other images."""
    return _find_with_endings(image, MASK_ENDINGS, known)


def _find_with_endings(image: PurePath, endings: Sequence[str], known: dict[str, Path]) -> Path | None:
    """Return the file that has an image's name, with or without its extension, and one of these endings."""
    for ending in endings:
        for name in (image, image.with_suffix("")):
            for suffix in IMAGE_SUFFIXES if ending else ("", *IMAGE_SUFFIXES):
                if mask := known.get(f"{name.as_posix()}{ending}{suffix}".lower()):
                    return mask
    return None


def find_capture_masks(
    layout: PosedCapture, posed: Sequence[PosedPhotograph], folder: Path, masks: Path | None, alphas: Sequence[bool]
) -> list[Path | None]:
    """Find the mask of each photograph of a capture, with a note. A photograph without a mask counts as a whole.

    The folder that was given comes first, then the layout's own masks. Then come a folder masks or mask of the
    capture, beside or below the images, and files beside the photographs. Masks of no photograph are noted.

    Args:
        layout: the capture as its layout has it.
        posed: its photographs.
        folder: the capture's folder.
        masks: the folder of masks that was given, or None.
        alphas: whether each photograph has alpha.

    Returns:
        A file, or None, for each photograph.

    Raises:
        InputError: the given folder has no masks of the photographs.
    """
    if masks is None and any(photograph.mask for photograph in posed):
        paths, where = [photograph.mask for photograph in posed], f"mask_path of {layout.source.name}"
    else:
        roots = (folder, layout.images.parent, layout.images)
        folders = [masks] if masks else [folder for root in roots for folder in _mask_folders(root)]
        paths, where = _find_in_folders([folder for folder in folders if folder.is_dir()], layout.images, posed)
        if masks and not any(paths):
            raise InputError(
                f"{masks}: missing masks: expected {posed[0].name}.png or {PurePosixPath(posed[0].name).stem}.png, as "
                "the photographs are named"
            )
    if any(paths):
        without = [photograph.name for photograph, path in zip(posed, paths) if path is None]
        rest = f"; {len(without)} without one count as a whole: {first_names(without)}" if without else ""
        assume(f"what is white in the masks of {where} counts, what is black does not{rest}")
    if any(alphas):
        assume(f"what is opaque counts in {sum(alphas)} of {len(posed)} photographs that have alpha")
    return paths


def _mask_folders(root: Path) -> list[Path]:
    """Return the folders of masks in a folder, in any case, in the order of MASK_FOLDERS."""
    with reading(root):
        found = sorted(path for path in root.iterdir() if path.name.lower() in MASK_FOLDERS)
    return sorted(found, key=lambda path: MASK_FOLDERS.index(path.name.lower()))


def _find_in_folders(
    folders: Sequence[Path], images: Path, posed: Sequence[PosedPhotograph]
) -> tuple[list[Path | None], str]:
    """Return the masks in the first of these folders that has any, or else beside the photographs.

    And the place in words.
    """
    beside = PhotoFiles(images)
    names = [PurePosixPath(photograph.name) for photograph in posed]
    others = [PurePosixPath(name) for name in beside.photographs]  # masks may also belong to photographs without a pose
    for folder in dict.fromkeys(folders):
        known = {name.lower(): path for name, path in PhotoFiles(folder).paths.items()}
        paths = [_find_named_mask(_mask_candidates(name, names, images), known) for name in names]
        owned = {_find_named_mask(_mask_candidates(name, others, images), known) for name in others}.union(paths)
        _note_unused_masks(
            folder, [name for name, path in known.items() if path not in owned], len(known), posed[0].name
        )
        if any(paths):
            return paths, str(folder)
    known = {name.lower(): path for name, path in beside.paths.items()}
    return [_find_mask_beside(name, known) for name in names], f"{images}, beside the photographs,"


def _mask_candidates(name: PurePosixPath, names: Sequence[PurePosixPath], images: Path) -> list[PurePosixPath]:
    """Return the paths that a photograph's mask may have in a folder of masks.

    A folder common to all may be left out.
    """
    inner = [PurePosixPath(*name.parts[1:])] if len({other.parts[0] for other in names}) == 1 < len(name.parts) else []
    return [name, images.name / name, *inner]


def _note_unused_masks(folder: Path, names: Sequence[str], count: int, example: str) -> None:
    """Note the files of a folder of masks that belong to no photograph."""
    if not names:
        return
    which = (
        "none of which belongs to a"
        if len(names) == count
        else f"{len(names)} of which belong{'s' * (len(names) == 1)} to no"
    )
    assume(
        f"{folder} holds {count} pictures, {which} photograph: {first_names(names)}; the mask of {example} is "
        f"{example}.png, {PurePosixPath(example).stem}.png, or one with .mask.png or _mask.png"
    )
