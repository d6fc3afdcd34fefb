"""Find image files by the names that a model or a JSON file has for them."""

from __future__ import annotations

import contextlib
import os
import unicodedata
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted, shown
from lightfield_gs.base.errors import InputError, reading

IMAGE_SUFFIXES = (".png", ".webp", ".jpg", ".jpeg")
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, ".tif", ".tiff", ".bmp", ".avif", ".heic", ".heif")
RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf")
# Photographs only where the model names them, or where there are no others; else they are depth maps
_FURTHER_SUFFIXES = (".exr", ".hdr", ".jxl", ".jp2", ".tga", ".ppm", *RAW_SUFFIXES)
_MAPS = ("mask", "depth", "normal", "segm", "semantic", "alpha")  # what folders of other pictures' names begin with
MASK_FOLDERS = ("masks", "mask")
MASK_ENDINGS = (".mask", "_mask")  # after a photograph's name, before .png: RealityScan's and Metashape's
_LEAST_PHOTOGRAPHS = 3  # least number of readable photographs; a model of fewer needs all of them


class PhotoFiles:
    """The image files in and below a folder, by their paths in it.

    Names match in any case and Unicode form, and with another extension, as in reduced copies of a set. Links are
    followed; hidden files are left out.

    Args:
        folder: the folder.
        others: further extensions of images, in lower case.
    """

    def __init__(self, folder: Path, others: Collection[str] = ()):
        self.folder = folder
        suffixes = {*PHOTO_SUFFIXES, *others}
        with reading(folder):
            found = sorted(path for path in _files_below(folder) if path.suffix.lower() in suffixes)
        self.paths = {path.relative_to(folder).as_posix(): path for path in found}
        self._folded: dict[str, list[Path]] = {}
        self._stems: dict[str, list[Path]] = {}
        for name, path in self.paths.items():
            self._folded.setdefault(_folded(name), []).append(path)
            self._stems.setdefault(_stem(name), []).append(path)

    def find(self, name: str) -> Path | None:
        """Return the file of this name; None where there is none, or several may be meant."""
        for found in ([self.paths[name]] if name in self.paths else [], self._folded.get(_folded(name), [])):
            if len(found) == 1:
                return found[0]
        stems = self._stems.get(_stem(name), [])
        return stems[0] if len(stems) == 1 else None

    def find_elsewhere(self, names: Sequence[str]) -> dict[str, Path]:
        """Find files of these names in other folders than the names have: all names of a folder in one other folder.

        That folder shares the most last parts with the names' folder; of several, it has the most of its names, and
        then is the outermost. If two files are alike, or a file has two names, none is found. Folders of masks, depth
        maps and the like, whose files have the same names, are left out.
        """
        here, groups = _by_folder(list(self.paths)), _by_folder(names)
        known = {
            other: ({_last(file) for file in files}, {_last(_stem(file)) for file in files})
            for other, files in here.items()
            if not any(part.lower().startswith(_MAPS) for part in PurePosixPath(other).parts)
        }
        found: dict[str, Path] = {}
        for folder, inside in groups.items():
            ranks: dict[str, tuple[int, int, int, int]] = {}
            for other, (lasts, stems) in known.items():
                exact = sum(_last(name) in lasts for name in inside)
                if count := sum(_last(_stem(name)) in stems for name in inside):
                    ranks[other] = (_shared_parts(folder, other), exact, count, -len(PurePosixPath(other).parts))
            best = [other for other, rank in ranks.items() if rank == max(ranks.values())]
            if len(best) == 1:
                moved = {name: self.find(f"{best[0]}/{PurePosixPath(name).name}".removeprefix("./")) for name in inside}
                found |= {name: path for name, path in moved.items() if path is not None}
        counts = Counter(found.values())
        return {name: path for name, path in found.items() if counts[path] == 1}

    @property
    def photographs(self) -> list[str]:
        """Names of the files that are no masks.

        A mask is in a folder of masks beside other images, or is named as the mask of an image beside it.
        """
        unmasked = [name for name in self.paths if not _in_mask_folder(name)]
        return [name for name in unmasked or self.paths if not self._masks_another(name)]

    def without(self, names: Collection[Path]) -> list[str]:
        """Return the names of the photographs that are not among these files."""
        used = set(names)
        return [name for name in self.photographs if self.paths[name] not in used]

    def _masks_another(self, name: str) -> bool:
        """Return whether a file is named as the mask of one beside it."""
        stem = _stem(name)
        owners = [stem.removesuffix(ending) for ending in MASK_ENDINGS if stem.endswith(ending)]
        return any(owner in self._folded or owner in self._stems for owner in owners)


# Name in its folder and path of each photograph, by its name in the model
LocatedFiles = dict[str, tuple[str, Path]]


@dataclass(frozen=True)
class FoundPhotographs:
    """Photographs that were found.

    Attributes:
        folder: the folder that they are in or below.
        files: by a model's names, without missing ones.
        others: names of other photographs in and below that folder.
    """

    folder: Path
    files: LocatedFiles
    others: list[str]


def find_photographs(
    folders: Sequence[Path], names: Sequence[str], known: LocatedFiles | None = None
) -> FoundPhotographs:
    """Find photographs in the first folder that has them all, or else in the folder that has the most.

    If a folder has no photographs by their whole names, the search uses the last parts. Other names and missing files
    are noted.

    Args:
        folders: where they may be, the likeliest first.
        names: as the model has them, with / between folders.
        known: known files of some photographs, which are kept.

    Raises:
        InputError: where too few are found; it names three that are missing.
    """
    there = [folder for folder in folders if folder.is_dir()]
    if not there:
        raise InputError(
            f"missing folder of photographs: expected {' or '.join(str(folder) for folder in folders[:4])}; give its "
            "place as images"
        )
    suffixes = {PurePosixPath(name).suffix.lower() for name in names} - {""}
    located = dict(known or {})
    wanted = [name for name in names if name not in located]
    best = _best_folder((PhotoFiles(folder, suffixes) for folder in there), wanted)
    if not best[1]:
        best = _best_folder((PhotoFiles(folder, {*suffixes, *_FURTHER_SUFFIXES}) for folder in there), wanted)
    if elsewhere := not best[1] and not located:
        sets = (PhotoFiles(folder, {*suffixes, *more}) for folder in there for more in ((), _FURTHER_SUFFIXES))
        best = _best_folder(sets, wanted, elsewhere=True)
    files, found = best
    relative = {path: name for name, path in files.paths.items()}
    inner = (
        os.path.commonpath([PurePosixPath(relative[path]).parent for path in found.values()])
        if elsewhere and found
        else ""
    )
    folder = files.folder / inner
    for name in wanted:
        if (path := found.get(name)) is not None:
            located[name] = (path.relative_to(folder).as_posix() if elsewhere else name, path)
    _note_other_names({name: relative[path] for name, path in found.items()}, len(names))
    if missing := [name for name in names if name not in located]:
        if is_too_few(len(located), len(names)):
            raise InputError(missing_message(folder, missing, len(names)))
        words = counted(len(missing), "photograph", len(names), "are missing and left out")
        assume(f"{folder}: {words}: {first_names(missing)}")
    others = [files.folder / name for name in files.without([path for _, path in located.values()])]
    within = [path.relative_to(folder).as_posix() for path in others if path.is_relative_to(folder)]
    return FoundPhotographs(folder, located, within)


def count_found(folders: Sequence[Path], names: Sequence[str]) -> int:
    """Return how many of these names have files in or below the folders, by their last parts."""
    sets = [PhotoFiles(folder) for folder in folders if folder.is_dir()]
    stems = {_last(_stem(name)) for files in sets for name in files.paths}
    return sum(_last(_stem(name)) in stems for name in names)


def is_too_few(left: int, count: int) -> bool:
    """Return whether `left` of `count` photographs are too few to go on with."""
    return left < min(count, _LEAST_PHOTOGRAPHS)


def missing_message(folder: Path, missing: Sequence[str], count: int) -> str:
    """Return the message about missing photographs."""
    return (
        f"{folder}: missing {len(missing)} of {count} photographs: {first_names(missing)}: put them there, or give "
        "the folder that has them as images"
    )


def first_names(names: Sequence[str]) -> str:
    """List the first three names; of long ones, the end."""
    return ", ".join(name[-80:] for name in names[:3]) + (", ..." if len(names) > 3 else "")


def _best_folder(
    sets: Iterable[PhotoFiles], names: Sequence[str], elsewhere: bool = False
) -> tuple[PhotoFiles, dict[str, Path]]:
    """Return the first of these folders with the most photographs of these names, and their paths."""
    best: tuple[PhotoFiles, dict[str, Path]] | None = None
    for files in sets:
        if elsewhere:
            found = files.find_elsewhere(names)
        else:
            found = {name: path for name in names if (path := files.find(name)) is not None}
        if best is None or len(found) > len(best[1]):
            best = files, found
        if len(found) == len(names):
            break
    assert best is not None  # there is a folder
    return best


def _note_other_names(found: dict[str, str], count: int) -> None:
    """Note photographs whose folder or extension differs from the model's names."""
    others = [(name, file) for name, file in found.items() if _folded(file) != _folded(name)]
    if others:
        name, file = others[0]
        words = counted(len(others), "photograph", count, "are found by the last parts of their names")
        assume(f"{words}, without folders or extensions: {first_names([name])} is {file}")


def _files_below(folder: Path, above: tuple[str, ...] = ()) -> Iterator[Path]:
    """Yield visible files in and below a folder.

    Args:
        above: Real paths of the folders above it, where circular links end.
    """
    real = os.path.realpath(folder)
    if real in above:
        return
    with os.scandir(folder) as entries:
        for entry in entries:
            if is_hidden(entry.name):
                continue
            path = folder / entry.name
            if entry.is_dir():
                with contextlib.suppress(PermissionError):
                    yield from _files_below(path, (*above, real))
            elif entry.is_file():
                yield path


def _shared_parts(one: str, other: str) -> int:
    """Return how many last parts two paths of folders have in common."""
    pairs = zip(reversed(PurePosixPath(_folded(one)).parts), reversed(PurePosixPath(_folded(other)).parts))
    count = 0
    for first, second in pairs:
        if first != second:
            break
        count += 1
    return count


def _by_folder(names: Sequence[str]) -> dict[str, list[str]]:
    """Group names by their folders."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(PurePosixPath(name).parent.as_posix(), []).append(name)
    return groups


def _last(name: str) -> str:
    return PurePosixPath(_folded(name)).name


def _folded(name: str) -> str:
    """Fold the case and the Unicode form of a name: macOS stores accents as separate characters."""
    return unicodedata.normalize("NFC", name).lower()


def names_outside(masks: Path | None, folder: Path, names: Sequence[str]) -> list[str]:
    """Return the names of files in a folder that are not in a folder of masks."""
    return [name for name in names if masks is None or not (folder / name).absolute().is_relative_to(masks.absolute())]


def is_hidden(name: str) -> bool:
    """Return whether a file or folder of this name is hidden."""
    return name.startswith(".")


def _in_mask_folder(name: str) -> bool:
    return any(part.lower() in MASK_FOLDERS for part in PurePosixPath(name).parts[:-1])


def _stem(name: str) -> str:
    path = PurePosixPath(_folded(name))
    return path.with_suffix("").as_posix() if path.name else path.as_posix()


def find_image(field: str, folder: Path, name: Any) -> Path:
    r"""Return the image that a data file names, in or below a folder.

    The name may have / or \ between folders, no extension, and another case than the file.

    Args:
        field: the file and field of the name, for messages.
        folder: the folder that the name is relative to.
        name: the field's value.

    Raises:
        InputError: where there is no such image, or several that differ in case.
    """
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"{field}: expected the name of an image, got {shown(name)}")
    try:
        return _find_file(field, folder, name)
    except (OSError, UnicodeEncodeError) as error:
        raise InputError(f"{field}: {shown(name)}: {error.args[-1]}") from None


def _find_file(field: str, folder: Path, name: str) -> Path:
    """Find the image of find_image; raises also OSError and UnicodeEncodeError for a name that no file can have."""
    base = (folder / name).resolve()
    if not base.is_file():  # a backslash separates folders, unless it is part of the file's name
        base = (folder / name.replace("\\", "/")).resolve()
    if not base.is_relative_to(folder.resolve()):
        raise InputError(f"{field}: {shown(name)} leads out of {folder}; put the images into that folder")
    for exact in (True, False):
        found = _files_named(base, exact)
        if len(found) > 1:
            names = " or ".join(path.name for path in found[:3])
            raise InputError(f"{field}: {shown(name)} may be {names}: rename one")
        if found:
            return found[0]
    raise InputError(
        f"{field}: missing image {base}: expected such a file, or with one of {', '.join(IMAGE_SUFFIXES)} added"
    )


def _files_named(base: Path, exact: bool) -> list[Path]:
    """Return images of this name: with its extension, or the first of IMAGE_SUFFIXES that exists.

    If not `exact`, names and folders may differ from it in case; then there may be several.
    """
    names = [base.name + suffix for suffix in ("", *IMAGE_SUFFIXES)]
    if exact:
        found = [base.with_name(name) for name in names]
        return [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file()][:1]
    entries = [
        entry
        for folder in _folders_named(base.parent)
        for entry in sorted(folder.iterdir())
        if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file()
    ]
    for name in names:
        if found := [entry for entry in entries if entry.name.lower() == name.lower()]:
            return found
    return []


def _folders_named(folder: Path) -> list[Path]:
    """Return this folder; where it does not exist, folders whose paths differ from it in case only."""
    if folder.is_dir() or folder.parent == folder:
        return [folder]
    return [
        entry
        for parent in _folders_named(folder.parent)
        for entry in sorted(parent.iterdir())
        if entry.name.lower() == folder.name.lower() and entry.is_dir()
    ]
