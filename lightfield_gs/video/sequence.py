"""Sequences of images: a folder, or a video, which is decoded frame by frame."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.atomic import checked_path, sha256
from lightfield_gs.io.depth_names import depth_maps_beside
from lightfield_gs.io.file_kinds import VIDEO_INPUTS
from lightfield_gs.io.images import write_image
from lightfield_gs.io.stereo_names import PairLayout
from lightfield_gs.video.decoding import decode, timeline

PICTURES: tuple[str, ...] = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".heic", ".heif", ".avif")
PICTURES += (".bmp", ".mpo", ".jps", ".pns")
_MAPS = (*PICTURES, ".npy", ".npz")


@dataclass(frozen=True)
class ImageSequence:
    """Images in a row.

    Attributes:
        path: the folder or the video.
        count: of images.
        files: of a folder, in order.
        fps: of a video; None where it does not tell.
        order: of a video, see Timeline.
        maps: whether they are depths.
        notes: lines about conversions.
        pair: of a video, where each frame has two eyes' pictures, as its metadata says.
    """

    path: Path
    count: int
    files: tuple[Path, ...] = ()
    fps: Fraction | None = None
    order: tuple[int, ...] = ()
    maps: bool = False
    notes: tuple[str, ...] = ()
    pair: PairLayout | None = None

    def pictures(self, numbers: list[int], folder: Path) -> Iterator[tuple[int, Path]]:
        """Yield the files of the images of these increasing numbers.

        Frames of a video are written to `folder`, and exist until the next is asked for. Raises InputError.
        """
        if self.files:
            yield from ((number, self.files[number]) for number in numbers)
            return
        name = folder / f"{self.path.stem}.png"
        for number, pixels in self.frames(numbers):
            write_image(name, pixels)
            yield number, name

    def frames(self, numbers: Iterable[int]) -> Iterator[tuple[int, np.ndarray]]:
        """Yield the frames of a video of these increasing numbers; see `decode`. Raises InputError."""
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
        """Return the SHA-256 over the contents of its files."""
        return sha256(*(self.files or (self.path,)))


def is_sequence(path: str | Path) -> bool:
    """Return whether a path is a video by its name, or a folder that holds images and no scene."""
    path = checked_path(path)
    if not path.is_dir():
        return path.suffix.lower() in VIDEO_INPUTS
    return not (path / "meta.json").exists() and bool(files_in(path, PICTURES))


def open_sequence(path: str | Path, maps: bool = False, in_time: bool = True) -> ImageSequence:
    """Open the images of a folder, in natural order of their names, or of a video.

    Args:
        path: the folder or the video.
        maps: whether they are depths, which may also be .npy and .npz files.
        in_time: see `timeline`.

    Raises:
        InputError: there are no images.
    """
    path = checked_path(path)
    if not path.is_dir():
        seen = timeline(path, in_time)
        return ImageSequence(path, len(seen.order), (), seen.fps, seen.order, maps, seen.notes, seen.pair)
    pictures, beside = pictures_and_maps(path)
    files = (beside or files_in(path, _MAPS)) if maps else pictures
    if not files:
        raise InputError(f"{path}: expected a folder of pictures ({', '.join(_MAPS if maps else PICTURES)}), got none")
    return ImageSequence(path, len(files), tuple(files))


def pictures_and_maps(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the images of a folder in order, and the depth maps that lie beside them by their names.

    Either every image has a map, or no image has one. Raises InputError where only some images have one.
    """
    files = files_in(folder, _MAPS)
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


def files_in(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of a folder with these suffixes, in natural order, without hidden ones. Raises InputError."""
    with reading(folder):
        files = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    return sorted(files, key=natural_order)


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Return the sort key by which frame9 comes before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]
