"""The pictures of a sequence: a folder of them, or a video, whose frames are taken out one by one."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.atomic import sha256
from lightfield_gs.io.depth_names import depth_maps_beside
from lightfield_gs.io.file_kinds import VIDEO_INPUTS
from lightfield_gs.io.images import write_image
from lightfield_gs.video.decoding import decode, timeline

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".heic", ".heif", ".avif", ".bmp")
_MAPS = (*PICTURES, ".npy", ".npz")


@dataclass(frozen=True)
class Sequence:
    """Pictures in a row. path: of the folder or the video; files: of a folder, in order; count: of pictures; fps: of a
    video, None where it does not say; order: of a video, see Timeline; maps: they are depths; notes: lines on what is
    done to them."""

    path: Path
    count: int
    files: tuple[Path, ...] = ()
    fps: Fraction | None = None
    order: tuple[int, ...] = ()
    maps: bool = False
    notes: tuple[str, ...] = ()

    def pictures(self, numbers: list[int], folder: Path) -> Iterator[tuple[int, Path]]:
        """The files of the pictures of these numbers, which increase; those of a video are written to `folder`, and
        are there until the next is asked for. Raises InputError."""
        if self.files:
            yield from ((number, self.files[number]) for number in numbers)
            return
        name = folder / f"{self.path.stem}.png"
        for number, pixels in self.frames(numbers):
            write_image(name, pixels)
            yield number, name

    def frames(self, numbers: Iterable[int]) -> Iterator[tuple[int, np.ndarray]]:
        """The frames of a video of these numbers, which increase: see `decode`. Raises InputError."""
        wanted = deque(numbers)
        last = wanted[-1] if wanted else 0
        for index, pixels in enumerate(decode(self.path, self.maps) if wanted else ()):
            while wanted and self.order[wanted[0]] == index:
                yield wanted.popleft(), pixels
            if not wanted:
                return
        if wanted:
            raise InputError(f"{self.path} ends before its frame {last}; it is cut, or its header counts wrongly")

    def digest(self) -> str:
        """SHA-256 over the contents of its files."""
        return sha256(*(self.files or (self.path,)))


def is_sequence(path: str | Path) -> bool:
    """Whether a path is a video by its name, or a folder that holds pictures, and no scene of some format."""
    path = checked_path(path)
    if not path.is_dir():
        return path.suffix.lower() in VIDEO_INPUTS
    return not (path / "meta.json").exists() and bool(_files(path, PICTURES))


def open_sequence(path: str | Path, maps: bool = False, in_time: bool = True) -> Sequence:
    """The pictures of a folder, in the order of their names, numbers in them by value; or of a video.

    maps: of depths, which may be files of numbers as well. in_time: see `timeline`. Raises InputError where there are
    none.
    """
    path = checked_path(path)
    if not path.is_dir():
        seen = timeline(path, in_time)
        return Sequence(path, len(seen.order), (), seen.fps, seen.order, maps, seen.notes)
    pictures, beside = pictures_and_maps(path)
    files = (beside or _files(path, _MAPS)) if maps else pictures
    if not files:
        raise InputError(f"{path}: expected a folder of pictures ({', '.join(_MAPS if maps else PICTURES)}), got none")
    return Sequence(path, len(files), tuple(files))


def pictures_and_maps(folder: Path) -> tuple[list[Path], list[Path]]:
    """The pictures of a folder in order, and the depth maps that lie beside them by their names, one for each; of the
    latter none where none do. Raises InputError where only some pictures have one."""
    files = _files(folder, _MAPS)
    beside = depth_maps_beside(path.name for path in files)
    maps = {name for names in beside.values() for name in names}
    pictures = [path for path in files if path.suffix.lower() in PICTURES and path.name not in maps]
    without = [path.name for path in pictures if path.name not in beside]
    if beside and without:
        raise InputError(
            f"{folder}: {len(beside)} of its pictures have a depth map beside them, as {next(iter(beside))}, and "
            f"{len(without)} have none, as {without[0]}; give all of them one, or put the maps into another folder"
        )
    return pictures, [folder / beside[path.name][0] for path in pictures if beside]


def _files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    with reading(folder):
        files = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    return sorted(files, key=_natural)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """So that frame9 comes before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]
