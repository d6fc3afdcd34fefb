"""The pictures of a sequence: a folder of them, or a video, whose frames are taken out one by one."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.depth_names import depth_maps_beside
from lightfield_gs.io.hashes import sha256_of
from lightfield_gs.io.images import MAX_PIXELS, write_image
from lightfield_gs.video.av_library import av_library

VIDEO_INPUTS = (".mp4", ".mkv", ".mov", ".webm", ".avi", ".m4v")
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".exr", ".heic", ".heif", ".avif", ".bmp")
_MAPS = (*PICTURES, ".npy", ".npz")


@dataclass(frozen=True)
class Sequence:
    """Pictures in a row. path: of the folder or the video; files: of a folder, in order; count: of pictures; fps: of a
    video, None where it does not say."""

    path: Path
    count: int
    files: tuple[Path, ...] = ()
    fps: Fraction | None = None

    def pictures(self, numbers: list[int], folder: Path) -> Iterator[tuple[int, Path]]:
        """The files of the pictures of these numbers, which increase; those of a video are written to `folder`, and
        are there until the next is asked for. Raises InputError."""
        if self.files:
            yield from ((number, self.files[number]) for number in numbers)
            return
        wanted, name = set(numbers), folder / f"{self.path.stem}.png"
        for number, pixels in enumerate(_decoded(self.path)):
            if number in wanted:
                write_image(name, pixels)
                yield number, name
                if number == numbers[-1]:
                    return
        raise InputError(f"{self.path} ends before its frame {numbers[-1]}; it is cut, or its header counts wrongly")

    def digest(self) -> str:
        """SHA-256 over the contents of its files."""
        return sha256_of(*(self.files or (self.path,)))


def is_sequence(path: str | Path) -> bool:
    """Whether a path is a video by its name, or a folder that holds pictures, and no scene of some format."""
    path = checked_path(path)
    if not path.is_dir():
        return path.suffix.lower() in VIDEO_INPUTS
    return not (path / "meta.json").exists() and bool(_files(path, PICTURES))


def open_sequence(path: str | Path, maps: bool = False) -> Sequence:
    """The pictures of a folder, in the order of their names, numbers in them by value; or of a video.

    maps: of depths, which may be files of numbers as well. Raises InputError where there are none.
    """
    path = checked_path(path)
    if not path.is_dir():
        return _of_video(path)
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


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """A folder for the pictures of a video, gone at the end."""
    with tempfile.TemporaryDirectory(prefix="lightfield-gs-") as folder:
        yield Path(folder)


def _files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    with reading(folder):
        files = [path for path in folder.iterdir() if path.suffix.lower() in suffixes and not path.name.startswith(".")]
    return sorted(files, key=_natural)


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """So that frame9 comes before frame10."""
    parts = re.split(r"(\d+)", path.name)
    return [(1, int(part), "") if part.isdecimal() else (0, 0, part) for part in parts]


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """PyAV's container and the first stream of pictures. Raises InputError, of whatever FFmpeg finds wrong."""
    with reading(path):
        path.open("rb").close()
    av = av_library(f"{path}: a video")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path}: expected a video, got a file without pictures")
            stream = container.streams.video[0]
            if stream.width * stream.height > MAX_PIXELS:
                raise InputError(f"{path}: {stream.width} x {stream.height} pixels; expected at most {MAX_PIXELS}")
            stream.thread_type = "AUTO"
            yield container, stream
    except av.FFmpegError as error:
        raise InputError(f"{path} is not a video that can be read: {error.strerror or error}") from error


def _of_video(path: Path) -> Sequence:
    with _opened(path) as (container, stream):
        # What the header says is often 0 or wrong, and packets are counted without being decoded
        count = sum(packet.size > 0 for packet in container.demux(stream))
        rate = stream.average_rate
    if not count:
        raise InputError(f"{path}: expected a video, got one without frames")
    return Sequence(path, count, fps=None if not rate else Fraction(rate))


def _decoded(path: Path) -> Iterator[np.ndarray]:
    """The frames as they are seen, uint8 [H, W, 3]."""
    with _opened(path) as (container, stream):
        for frame in container.decode(stream):
            pixels = frame.to_ndarray(format="rgb24")
            yield np.ascontiguousarray(np.rot90(pixels, round(getattr(frame, "rotation", 0) / 90) % 4))
