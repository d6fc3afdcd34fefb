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
# Photographs only where the model names them so, or where there are no others: beside these they are maps of depth
_FURTHER_SUFFIXES = (".exr", ".hdr", ".jxl", ".jp2", ".tga", ".ppm", *RAW_SUFFIXES)
_MAPS = ("mask", "depth", "normal", "segm", "semantic", "alpha")  # what folders of other pictures' names begin with
MASK_FOLDERS = ("masks", "mask")
MASK_ENDINGS = (".mask", "_mask")  # after a photograph's name, before .png: RealityScan's and Metashape's
_LEAST_PHOTOGRAPHS = 3  # that have to be left of more; a model of fewer needs all


class PhotoFiles:
    """The pictures in and below a folder, by their paths in it: in any case and Unicode form, and with another
    extension, as sets that were reduced have them. Links are followed; what is hidden is no photograph.

    Args:
        folder: where they are.
        others: further extensions that pictures have here, in lower case.
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
        """The picture of this name; None where there is none, or several that it may mean."""
        for found in ([self.paths[name]] if name in self.paths else [], self._folded.get(_folded(name), [])):
            if len(found) == 1:
                return found[0]
        stems = self._stems.get(_stem(name), [])
        return stems[0] if len(stems) == 1 else None

    def find_elsewhere(self, names: Sequence[str]) -> dict[str, Path]:
        """Pictures of these names in other folders than the names say: all of a folder are in one other folder.

        That is the one with which the names' folder shares the most last parts; of several, that which has the most of
        its names, and then the outermost. Where two are alike, or a picture has two names, none is found. Folders of
        masks and the like are none, whose pictures have the same names.
        """
        here, groups = _by_folder(list(self.paths)), _by_folder(names)
        known = {
            place: ({_last(file) for file in files}, {_last(_stem(file)) for file in files})
            for place, files in here.items()
            if not any(part.lower().startswith(_MAPS) for part in PurePosixPath(place).parts)
        }
        found: dict[str, Path] = {}
        for folder, inside in groups.items():
            ranks: dict[str, tuple[int, int, int, int]] = {}
            for place, (lasts, stems) in known.items():
                exact = sum(_last(name) in lasts for name in inside)
                if count := sum(_last(_stem(name)) in stems for name in inside):
                    ranks[place] = (_shared_parts(folder, place), exact, count, -len(PurePosixPath(place).parts))
            best = [place for place, rank in ranks.items() if rank == max(ranks.values())]
            if len(best) == 1:
                moved = {name: self.find(f"{best[0]}/{PurePosixPath(name).name}".removeprefix("./")) for name in inside}
                found |= {name: path for name, path in moved.items() if path is not None}
        counts = Counter(found.values())
        return {name: path for name, path in found.items() if counts[path] == 1}

    @property
    def photographs(self) -> list[str]:
        """Names of the pictures that are no masks: neither in a folder of masks beside others, nor named as the mask of
        a picture beside them."""
        unmasked = [name for name in self.paths if not _in_mask_folder(name)]
        return [name for name in unmasked or self.paths if not self._masks_another(name)]

    def without(self, names: Collection[Path]) -> list[str]:
        """Names of the photographs that are not among these."""
        used = set(names)
        return [name for name in self.photographs if self.paths[name] not in used]

    def _masks_another(self, name: str) -> bool:
        """Whether a picture is named as the mask of one that lies beside it."""
        stem = _stem(name)
        owners = [stem.removesuffix(ending) for ending in MASK_ENDINGS if stem.endswith(ending)]
        return any(owner in self._folded or owner in self._stems for owner in owners)


Places = dict[str, tuple[str, Path]]  # by a model's names of photographs: their names in their folder, and paths


@dataclass(frozen=True)
class FoundPhotographs:
    """Photographs in and below a folder, of which it has others too. Those that are missing have no place."""

    folder: Path
    places: Places
    others: list[str]


def photographs_in(folders: Sequence[Path], names: Sequence[str], known: Places | None = None) -> FoundPhotographs:
    """The photographs of these names in the first of these folders that has them all, or else the most of them.

    Where a folder has none by their whole names, they are looked for by their last parts. What is found otherwise than
    named, and what is left out as missing, is said.

    Args:
        folders: where they may be, the likeliest first.
        names: as the model has them, with / between folders.
        known: places of some of them, which are kept.

    Raises InputError where too few are there, with how many and the first three.
    """
    there = [folder for folder in folders if folder.is_dir()]
    if not there:
        raise InputError(
            f"missing folder of photographs: expected {' or '.join(str(folder) for folder in folders[:4])}; give its "
            "place as images"
        )
    named_so = {PurePosixPath(name).suffix.lower() for name in names} - {""}
    places = dict(known or {})
    wanted = [name for name in names if name not in places]
    best = _most((PhotoFiles(folder, named_so) for folder in there), wanted)
    if not best[1]:
        best = _most((PhotoFiles(folder, {*named_so, *_FURTHER_SUFFIXES}) for folder in there), wanted)
    if elsewhere := not best[1] and not places:
        sets = (PhotoFiles(folder, {*named_so, *more}) for folder in there for more in ((), _FURTHER_SUFFIXES))
        best = _most(sets, wanted, elsewhere=True)
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
            places[name] = (path.relative_to(folder).as_posix() if elsewhere else name, path)
    _say_other_names({name: relative[path] for name, path in found.items()}, len(names))
    if missing := [name for name in names if name not in places]:
        if too_few(len(places), len(names)):
            raise InputError(missing_photographs(folder, missing, len(names)))
        words = counted(len(missing), "photograph", len(names), "are missing and left out")
        assume(f"{folder}: {words}: {first_names(missing)}")
    others = [files.folder / name for name in files.without([path for _, path in places.values()])]
    within = [path.relative_to(folder).as_posix() for path in others if path.is_relative_to(folder)]
    return FoundPhotographs(folder, places, within)


def how_many_there(folders: Sequence[Path], names: Sequence[str]) -> int:
    """Of how many of these names there are files in or below the folders, by the last parts."""
    sets = [PhotoFiles(folder) for folder in folders if folder.is_dir()]
    stems = {_last(_stem(name)) for files in sets for name in files.paths}
    return sum(_last(_stem(name)) in stems for name in names)


def too_few(left: int, count: int) -> bool:
    """Whether `left` of `count` photographs are too few to go on with."""
    return left < min(count, _LEAST_PHOTOGRAPHS)


def missing_photographs(folder: Path, missing: Sequence[str], count: int) -> str:
    """That `missing` of `count` photographs are not there, in words."""
    return (
        f"{folder}: missing {len(missing)} of {count} photographs: {first_names(missing)}: put them there, or give "
        "the folder that has them as images"
    )


def first_names(names: Sequence[str]) -> str:
    """The first three; of long ones, the end."""
    return ", ".join(name[-80:] for name in names[:3]) + (", ..." if len(names) > 3 else "")


def _most(
    sets: Iterable[PhotoFiles], names: Sequence[str], elsewhere: bool = False
) -> tuple[PhotoFiles, dict[str, Path]]:
    """The first of these folders that has the most photographs of these names, and their paths."""
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


def _say_other_names(found: dict[str, str], count: int) -> None:
    """Says of which of `count` photographs the folder or the extension is another than the model's names have."""
    others = [(name, file) for name, file in found.items() if _folded(file) != _folded(name)]
    if others:
        name, file = others[0]
        words = counted(len(others), "photograph", count, "are found by the last parts of their names")
        assume(f"{words}, without folders or extensions: {first_names([name])} is {file}")


def _files_below(folder: Path, above: tuple[str, ...] = ()) -> Iterator[Path]:
    """Files in and below a folder, but hidden ones. above: the real paths of folders above it, where links end."""
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
    """How many last parts two paths of folders have in common."""
    pairs = zip(reversed(PurePosixPath(_folded(one)).parts), reversed(PurePosixPath(_folded(other)).parts))
    count = 0
    for first, second in pairs:
        if first != second:
            break
        count += 1
    return count


def _by_folder(names: Sequence[str]) -> dict[str, list[str]]:
    """Names by their folders."""
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(PurePosixPath(name).parent.as_posix(), []).append(name)
    return groups


def _last(name: str) -> str:
    return PurePosixPath(_folded(name)).name


def _folded(name: str) -> str:
    """A name without its case and its form of Unicode: macOS takes letters with accents apart."""
    return unicodedata.normalize("NFC", name).lower()


def outside(masks: Path | None, folder: Path, names: Sequence[str]) -> list[str]:
    """The names of pictures in a folder that are not in a folder of masks."""
    return [name for name in names if masks is None or not (folder / name).absolute().is_relative_to(masks.absolute())]


def is_hidden(name: str) -> bool:
    """Whether the name of a file or folder is that of a hidden one."""
    return name.startswith(".")


def _in_mask_folder(name: str) -> bool:
    return any(part.lower() in MASK_FOLDERS for part in PurePosixPath(name).parts[:-1])


def _stem(name: str) -> str:
    path = PurePosixPath(_folded(name))
    return path.with_suffix("").as_posix() if path.name else path.as_posix()


def named_image(field: str, folder: Path, name: Any) -> Path:
    """The image in or below `folder` that a data file names: with / or \\ between folders, with or without its
    extension, in whatever case.

    field: where the name stands, for messages. Raises InputError where there is none, or several that differ in case.
    """
    if not isinstance(name, str) or not name.strip() or "\0" in name:
        raise InputError(f"{field}: expected the name of an image, got {shown(name)}")
    try:
        return _found(field, folder, name)
    except (OSError, UnicodeEncodeError) as error:
        raise InputError(f"{field}: {shown(name)}: {error.args[-1]}") from None


def _found(field: str, folder: Path, name: str) -> Path:
    """What named_image finds; raises OSError or UnicodeEncodeError for a name that no file can have."""
    base = (folder / name).resolve()
    if not base.is_file():  # Windows wrote it, unless the file's own name has a backslash
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
    """Images of this name, with its extension or the first of IMAGE_SUFFIXES that there is; or, if not `exact`, of
    names that differ from it in case only, of folders too."""
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
    """This folder; where there is none, those whose paths differ from it in case only."""
    if folder.is_dir() or folder.parent == folder:
        return [folder]
    return [
        entry
        for parent in _folders_named(folder.parent)
        for entry in sorted(parent.iterdir())
        if entry.name.lower() == folder.name.lower() and entry.is_dir()
    ]
