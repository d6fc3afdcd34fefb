"""Files of Gaussians in all formats; the content of a file decides its format, then its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightfield_gs.base.checks import expect, real_number
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.file_kinds import begins_as_scene, refuse_unsupported
from lightfield_gs.io.scenes import gltf, gltf_writing, ksplat, ply, sog, splat, spz, streamed_sog, usd
from lightfield_gs.io.scenes.comments import ANTIALIASED_WARNING, is_antialiased
from lightfield_gs.io.scenes.gltf_file import MAGIC as GLTF_MAGIC
from lightfield_gs.io.scenes.packed import ZIP_MAGIC, is_packed_scene, unpack
from lightfield_gs.io.scenes.scene_arrays import Fields, Origin, SceneArrays

if TYPE_CHECKING:
    from lightfield_gs.scene.gaussians import Gaussians


@dataclass
class SceneFile:
    """The contents of a file of Gaussians.

    Attributes:
        gaussians: float32 on the CPU, N >= 1, SH degree 0..3.
        comments: text of the header's comment and obj_info lines, in file order.
        elements: other elements of a .ply of at most 64 KiB, without lists, by name: structured arrays.
        notes: suspicious contents and decisions of the reader, one line each, without the file's name.
        kind: format and version in words.
    """

    gaussians: Gaussians
    comments: tuple[str, ...] = ()
    elements: dict[str, np.ndarray] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    kind: str = ""

    def warnings(self) -> list[str]:
        """Return all that a user of the Gaussians alone should know, one line each."""
        lines = list(self.notes)
        if is_antialiased(self.comments):
            lines.append(ANTIALIASED_WARNING)
        if any(self.gaussians.origin):
            lines.append(
                f"the means are given from the origin {self.gaussians.origin}; cameras in the file's coordinates fit "
                "after relative_to(gaussians.origin)"
            )
        return lines


def read_scene(
    path: str | Path, *, skip_invalid: bool = False, time: float | None = None, lod: int | None = None
) -> SceneFile:
    """Read a file of Gaussians.

    Formats are 3DGS .ply, compressed .ply (SuperSplat), .spz (versions 1 to 4), .splat, .ksplat, glTF with
    KHR_gaussian_splatting (.glb, .gltf), and OpenUSD with ParticleField3DGaussianSplat (.usd, .usda, .usdc, .usdz). A
    .sog (versions 1 and 2) may be a ZIP, a folder or its meta.json. The axes are a .ply's (right, down, forward): those
    of an .spz, of glTF and of OpenUSD are turned to them. A .ply may be text or binary of either byte order, with
    properties in any order and number type. Properties that no Gaussian has are ignored. Coordinates stored as double,
    far from zero, become relative to an origin of whole numbers near them; Gaussians.origin holds it.

    Args:
        path: file or folder.
        skip_invalid: leave out Gaussians with invalid values, and count them in a note. Invalid are values that are not
            finite, a rotation of zeros, and a scale that overflows. Infinite logits and a log scale of -inf are valid.
        time: time at which moving Gaussians (Spacetime Gaussians) are read, in the units of their file, mostly 0..1.
            None: the median of the times at which they are most opaque, which a note states.
        lod: level of detail of a streamed SOG, 0 being the finest. None: the finest that fits half of the free memory,
            which a note states.

    Raises:
        InputError: the file has an unknown format, is cut, has wrong counts, or lacks a property. Without skip_invalid:
            a value is invalid. The message names property, index and count.
    """
    from lightfield_gs.scene.gaussians import from_arrays

    stored = read_arrays(path, skip_invalid=skip_invalid, time=time, lod=lod)
    gaussians = from_arrays(stored.fields, stored.origin)
    return SceneFile(gaussians, stored.comments, stored.elements, stored.notes, stored.kind)


def write_scene(gaussians: Gaussians, path: str | Path, comments: Sequence[str] = ()) -> list[str]:
    """Write one set of Gaussians, complete or not at all, as .ply, glTF, OpenUSD, .spz (version 3) or .splat.

    A standard 3DGS .ply is float32, except for centres with an origin: these are double, with the origin added. glTF
    and OpenUSD have float32 and a place of the node in double.

    Args:
        gaussians: one set of N >= 1.
        path: the file; its ending decides the format.
        comments: texts of one line each for the header of a .ply, which may have 64 KiB, or the extras of glTF.

    Returns:
        Losses by the format, one line each.

    Raises:
        InputError: Gaussians are a batch, empty or invalid, comments have several lines, or the file cannot be written.
    """
    from lightfield_gs.scene.gaussians import Gaussians

    expect("gaussians", gaussians, Gaussians)
    if gaussians.is_batched:
        raise InputError(f"a file holds one set of Gaussians, got a batch of {gaussians.means.shape[0]}; save one")
    if gaussians.count == 0:
        raise InputError(f"{path}: there are no Gaussians to write; expected at least one")
    values = gaussians.detach().validate().fields()
    arrays = {name: value.cpu().double().numpy() for name, value in values.items()}
    return write_arrays(path, arrays, gaussians.origin, comments)


@dataclass(frozen=True)
class Format:
    """A format of files of Gaussians.

    Attributes:
        name: in words.
        suffixes: endings of its files.
        starts: first bytes of its files, for formats that have such.
        read: reads a file; takes its path and skip_invalid.
        write: writes a file; takes its path, the float64 fields, the origin and the comments, and returns losses, one
            line each. None for formats that are only read.
        keeps_comments: whether a written file has its comments.
    """

    name: str
    suffixes: tuple[str, ...]
    starts: tuple[bytes, ...]
    read: Callable[[Path, bool], SceneArrays]
    write: Callable[[str | Path, Fields, Origin, Sequence[str]], list[str]] | None = None
    keeps_comments: bool = False


_PLY = Format(".ply", (".ply",), (b"ply\n", b"ply\r"), ply.read, ply.write, True)
_SOG = Format("SOG", (".sog", ".zip"), (ZIP_MAGIC,), sog.read)
_USD = Format("OpenUSD", usd.SUFFIXES, usd.STARTS, usd.read, usd.write, True)
FORMATS = (
    _PLY,
    Format("glTF", (".glb", ".gltf"), (GLTF_MAGIC,), gltf.read, gltf_writing.write, True),
    Format("SPZ", (".spz",), (b"NGSP", b"\x1f\x8b\x08\x00"), spz.read, spz.write),
    Format("splat", (".splat",), (), splat.read, splat.write),
    Format("ksplat", (".ksplat",), (), ksplat.read),
    _SOG,
    _USD,
)
_STREAMED = Format("streamed SOG", (), (), streamed_sog.read)
SUFFIXES = tuple(suffix for format in FORMATS for suffix in format.suffixes)
WRITTEN_SUFFIXES = tuple(suffix for format in FORMATS if format.write for suffix in format.suffixes)


def is_scene_path(path: Path) -> bool:
    """Tell whether a path is a scene, by its name, the contents of a folder, or the first bytes of the file.

    Scenes are files of these formats, which may be packed by gzip, and folders of a trainer. A SOG is given by its
    folder, its meta.json, or a lod-meta.json.
    """
    return (
        path.suffix.lower() in SUFFIXES
        or path.name.lower() == sog.META
        or (path / sog.META).is_file()
        or streamed_sog.is_streamed(path)
        or is_packed_scene(path)
        or begins_as_scene(path)
    )


def _find_format(path: Path) -> Format:
    """Return the format by content, then by name; .ply for neither, whose reader reports the error.

    Raises:
        InputError: the file is of a known kind that is not read.
    """
    if path.is_dir() or path.suffix.lower() == ".json":
        if streamed_sog.is_streamed(path):
            return _STREAMED
        if path.name.lower() == sog.META or (path / sog.META).is_file():
            return _SOG
    refuse_unsupported(path)
    if path.suffix.lower() == ".usdz":
        return _USD  # also a ZIP
    with open(path, "rb") as file:
        start = file.read(4)
    for format in FORMATS:
        if start in format.starts:
            return format
    return next((format for format in FORMATS if path.suffix.lower() in format.suffixes), _PLY)


def read_arrays(
    path: str | Path, *, skip_invalid: bool = False, time: float | None = None, lod: int | None = None
) -> SceneArrays:
    """Read a file of Gaussians as arrays; see read_scene."""
    expect("skip_invalid", skip_invalid, bool)
    if time is not None:
        time = real_number("time", time, -1e6, 1e6)
    path = checked_path(path)
    with reading(path):
        if not is_scene_path(path):
            refuse_unsupported(path)
        if path.is_file() and path.stat().st_size == 0:
            raise InputError(f"{path} is empty; export it or download it again")
        with unpack(path) as (inner, notes):
            stored = _read(inner, skip_invalid, time, lod)
        stored.notes[:0] = notes
        return stored


def _read(path: Path, skip_invalid: bool, time: float | None, lod: int | None) -> SceneArrays:
    format = _find_format(path)
    if format is _STREAMED:
        ply.refuse_time(path, time)
        return streamed_sog.read(path, skip_invalid, lod)
    if lod is not None:
        raise InputError(f"{path}: it is no streamed SOG, and has no levels of detail; leave out lod=")
    if format is _PLY:
        return ply.read(path, skip_invalid, time)
    if format is _USD:
        return usd.read(path, skip_invalid, time)
    ply.refuse_time(path, time)
    return format.read(path, skip_invalid)


def check_written_suffix(path: Path) -> str:
    """Return the lower-case ending of a file of Gaussians that can be written; raise InputError for others."""
    suffix = path.suffix.lower()
    if suffix not in WRITTEN_SUFFIXES:
        raise InputError(f"cannot write {path}: expected a name that ends in {', '.join(WRITTEN_SUFFIXES)}")
    return suffix


def keeps_comments(path: Path) -> bool:
    """Tell whether a written file of this name has its comments, and the framing among them."""
    is_index = path.name.lower() == streamed_sog.LOD_META
    return is_index or any(format.keeps_comments for format in FORMATS if path.suffix.lower() in format.suffixes)


def write_arrays(path: str | Path, fields: Fields, origin: Origin, comments: Sequence[str] = ()) -> list[str]:
    """Write the float64 fields of N >= 1 valid Gaussians; return losses as write_scene does."""
    path = checked_path(path)
    suffix = check_written_suffix(path)
    format = next(format for format in FORMATS if suffix in format.suffixes)
    assert format.write is not None
    return format.write(path, fields, origin, comments)
