"""What files of Gaussians hold, as arrays: one reader for each format, chosen by the file's content, then its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.checks import expect, real_number
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.scenes import ksplat, ply, ply_compressed, sog, sog_streamed, splat, spz
from lightfield_gs.io.scenes.packed import ZIP_MAGIC, is_packed_scene, unpacked
from lightfield_gs.io.scenes.ply_data import read_elements
from lightfield_gs.io.scenes.ply_header import HEADER_LIMIT_BYTES, read_header
from lightfield_gs.io.scenes.render_mode import stated_antialiased
from lightfield_gs.io.scenes.stored_scene import StoredScene
from lightfield_gs.io.unread import begins_as_scene, refuse_unread

Fields = dict[str, np.ndarray]


def _read_ply(path: Path, skip_invalid: bool, time: float | None = None) -> StoredScene:
    with open(path, "rb") as file:
        header = read_header(path, file.read(HEADER_LIMIT_BYTES))
    if ply_compressed.is_compressed(header):
        _refuse_time(path, time)
        ply_compressed.check_header(path, header)
        return ply_compressed.scene(path, header, read_elements(path, header), skip_invalid)
    ply.check_header(path, header)
    elements = read_elements(path, header)
    fields, origin, notes = ply.fields_of(path, elements.pop("vertex"), skip_invalid, time)
    return StoredScene(fields, origin, header.comments, elements, notes, "3DGS .ply")


@dataclass(frozen=True)
class Format:
    """A format of files of Gaussians.

    name: in words. suffixes: of its files. starts: what its content begins with, of formats that say so. read: the file
    at a path, told whether to leave out Gaussians without a meaning. write: the float64 fields to a path, told whether
    they were trained with anti-aliasing; returns what of them is lost, a line each; None where the format is only read.
    """

    name: str
    suffixes: tuple[str, ...]
    starts: tuple[bytes, ...]
    read: Callable[[Path, bool], StoredScene]
    write: Callable[[str | Path, Fields, bool], list[str]] | None = None


_PLY = Format(".ply", (".ply",), (b"ply\n", b"ply\r"), _read_ply)
FORMATS = (
    _PLY,
    Format("SPZ", (".spz",), (b"NGSP", b"\x1f\x8b\x08\x00"), spz.read, spz.write),
    Format("splat", (".splat",), (), splat.read, splat.write),
    Format("ksplat", (".ksplat",), (), ksplat.read),
    Format("SOG", (".sog", ".zip"), (ZIP_MAGIC,), sog.read),
)
_STREAMED = Format("streamed SOG", (), (), sog_streamed.read)
SUFFIXES = tuple(suffix for format in FORMATS for suffix in format.suffixes)
WRITTEN_SUFFIXES = (".ply", *(suffix for format in FORMATS if format.write for suffix in format.suffixes))


def is_scene_path(path: Path) -> bool:
    """Whether a path is, by its name, one of Gaussians: a file, the folder or meta.json of a SOG or the lod-meta.json
    of a streamed one, a file in gzip, or the folder of a trainer; or a file of any name that says so itself."""
    return (
        path.suffix.lower() in SUFFIXES
        or path.name.lower() == sog.META
        or (path / sog.META).is_file()
        or sog_streamed.is_streamed(path)
        or is_packed_scene(path)
        or begins_as_scene(path)
    )


def _format_of(path: Path) -> Format:
    """By content, which no name can belie, then by name; files of neither are taken for .ply, and say themselves that
    they are none. Raises InputError that names the kind where it is known and not read."""
    if sog_streamed.is_streamed(path):
        return _STREAMED
    if path.name.lower() == sog.META or path.is_dir() and (path / sog.META).is_file():
        return FORMATS[-1]
    refuse_unread(path)
    with open(path, "rb") as file:
        start = file.read(4)
    for format in FORMATS:
        if start in format.starts:
            return format
    return next((format for format in FORMATS if path.suffix.lower() in format.suffixes), _PLY)


def read_stored(path: str | Path, *, skip_invalid: bool = False, time: float | None = None) -> StoredScene:
    """Reads a file of Gaussians; see scene/files.py. Raises InputError."""
    expect("skip_invalid", skip_invalid, bool)
    if time is not None:
        time = real_number("time", time, -1e6, 1e6)
    path = checked_path(path)
    with reading(path):
        if not is_scene_path(path):
            refuse_unread(path)
        if path.is_file() and path.stat().st_size == 0:
            raise InputError(f"{path} is empty; export it or download it again")
        with unpacked(path) as (inner, notes):
            stored = _read(inner, skip_invalid, time)
        stored.notes[:0] = notes
        return stored


def _read(path: Path, skip_invalid: bool, time: float | None) -> StoredScene:
    format = _format_of(path)
    if format is _PLY:
        return _read_ply(path, skip_invalid, time)
    _refuse_time(path, time)
    return format.read(path, skip_invalid)


def _refuse_time(path: Path, time: float | None) -> None:
    if time is not None:
        raise InputError(f"{path}: its format holds no Gaussians that move; leave out --time (Python: time)")


def check_written_suffix(path: Path) -> str:
    """The suffix of a file of Gaussians that can be written, in lower case. Raises InputError."""
    suffix = path.suffix.lower()
    if suffix not in WRITTEN_SUFFIXES:
        raise InputError(f"cannot write {path}: expected a name that ends in {', '.join(WRITTEN_SUFFIXES)}")
    return suffix


def write_stored(
    path: str | Path, fields: Fields, origin: tuple[float, float, float], comments: Sequence[str] = ()
) -> list[str]:
    """Writes the float64 fields of N >= 1 valid Gaussians in the format that the name ends in; returns what is lost, a
    line each. Raises InputError."""
    path = checked_path(path)
    suffix = check_written_suffix(path)
    format = next(format for format in FORMATS if suffix in format.suffixes)
    if format.write is None:
        ply.write(path, fields, origin, comments)
        return []
    lost = format.write(path, fields, stated_antialiased(comments) is True)
    if any(origin):
        lost.append(f"centres are given from the origin {origin}, which a {suffix} cannot hold")
    if comments:
        lost.append(f"a {suffix} holds no comments: the framing, and what the scene was made by, are only in a .ply")
    return lost
