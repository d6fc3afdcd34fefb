"""Finding photographs by the names that a model has for them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.captures.views import IMAGE_SUFFIXES

PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, ".tif", ".tiff", ".bmp", ".avif", ".heic", ".heif")
MASK_FOLDERS = ("masks", "mask")
MASK_ENDINGS = (".mask", "_mask")  # after a photograph's name, before .png: RealityScan's and Metashape's


class PhotoFiles:
    """The pictures in and below a folder, by their paths in it: in any case, and with another extension, as sets that
    were reduced have them. Hidden ones, as the ._NAME.jpg that macOS leaves on other disks, are none."""

    def __init__(self, folder: Path):
        self.folder = folder
        with reading(folder):
            found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
        names = [(path.relative_to(folder), path) for path in found]
        self.paths = {name.as_posix(): path for name, path in names if not any(map(is_hidden, name.parts))}
        self._lower: dict[str, list[Path]] = {}
        self._stems: dict[str, list[Path]] = {}
        for name, path in self.paths.items():
            self._lower.setdefault(name.lower(), []).append(path)
            self._stems.setdefault(_stem(name), []).append(path)

    def find(self, name: str) -> Path | None:
        """The picture of this name; None where there is none, or several that it may mean."""
        for found in ([self.paths[name]] if name in self.paths else [], self._lower.get(name.lower(), [])):
            if len(found) == 1:
                return found[0]
        stems = self._stems.get(_stem(name), [])
        return stems[0] if len(stems) == 1 else None

    @property
    def photographs(self) -> list[str]:
        """Names of the pictures that are no masks: neither in a folder of masks beside others, nor named as the mask of
        a picture beside them."""
        outside = [name for name in self.paths if not _in_mask_folder(name)]
        return [name for name in outside or self.paths if not self._masks_another(name)]

    def without(self, names: Sequence[Path]) -> list[str]:
        """Names of the photographs that are not among these."""
        used = set(names)
        return [name for name in self.photographs if self.paths[name] not in used]

    def _masks_another(self, name: str) -> bool:
        """Whether a picture is named as the mask of one that lies beside it."""
        stem = _stem(name)
        owners = [stem.removesuffix(ending) for ending in MASK_ENDINGS if stem.endswith(ending)]
        return any(owner in self._lower or owner in self._stems for owner in owners)


def photographs_in(folders: Sequence[Path], names: Sequence[str]) -> tuple[PhotoFiles, list[Path]]:
    """The first of these folders that has all photographs of these names, or else that which has the most, and the
    paths of the photographs. Raises InputError that says how many are missing and names the first three."""
    best: tuple[int, PhotoFiles, list[Path | None]] | None = None
    for folder in folders:
        if folder.is_dir():
            files = PhotoFiles(folder)
            found = [files.find(name) for name in names]
            count = sum(path is not None for path in found)
            if count == len(names):
                return files, [path for path in found if path is not None]
            if best is None or count > best[0]:
                best = count, files, found
    if best is None:
        raise InputError(
            f"missing folder of photographs: expected {' or '.join(str(folder) for folder in folders[:4])}; give its "
            "place as images"
        )
    _, files, found = best
    missing = [name for name, path in zip(names, found) if path is None]
    raise InputError(missing_photographs(files.folder, missing, len(names)))


def missing_photographs(folder: Path, missing: Sequence[str], count: int) -> str:
    """That `missing` of `count` photographs are not there, in words."""
    return (
        f"{folder}: missing {len(missing)} of {count} photographs: {first_names(missing)}: put them there, or give "
        "the folder that has them as images"
    )


def first_names(names: Sequence[str]) -> str:
    """The first three; of long ones, the end."""
    return ", ".join(name[-80:] for name in names[:3]) + (", ..." if len(names) > 3 else "")


def is_hidden(name: str) -> bool:
    """Whether the name of a file or folder is that of a hidden one."""
    return name.startswith(".")


def _in_mask_folder(name: str) -> bool:
    return any(part.lower() in MASK_FOLDERS for part in PurePosixPath(name).parts[:-1])


def _stem(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix().lower()
