"""Scenes inside something else: the one in a ZIP, one that gzip has packed, the last one of a trainer's folder."""

from __future__ import annotations

import re
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.atomic import scratch_folder
from lightfield_gs.io.scenes.bounded import ALWAYS_BYTES, MOST_RATIO, check_promise, gunzip
from lightfield_gs.io.scenes.sog_files import BAD_ZIP, META
from lightfield_gs.io.scenes.sog_streamed import LOD_META
from lightfield_gs.io.scenes.spz_streams import GZIP_MAGIC, MAGIC
from lightfield_gs.io.unread import (
    ARCHIVE,
    ARRAYS,
    CHECKPOINT,
    GLTF,
    PICTURE_SUFFIXES,
    SCENE_SUFFIXES,
    USD,
    refuse_kind,
    scenes_among,
)

ZIP_MAGIC = b"PK\x03\x04"
_ITERATION = re.compile(r"(?:(?:.*/)?point_cloud/)?iteration_(\d{1,9})/point_cloud\.ply")  # of 3DGS and what follows it
_STEP = re.compile(r"(?:.*/)?ply/point_cloud_(\d{1,9})\.ply")  # of gsplat's simple_trainer
_PEEK_BYTES, _BLOCK_BYTES = 512, 1 << 20


def is_packed_scene(path: Path) -> bool:
    """Whether a path is, by its name or by what a folder holds, one that `unpacked` finds a scene in."""
    name = path.name.lower()
    return name.endswith(tuple(f"{suffix}.gz" for suffix in SCENE_SUFFIXES)) or bool(_trained(path))


def _trained(folder: Path) -> list[Path]:
    """The scenes of a trainer's folder, the last one at the end."""
    if not folder.is_dir():
        return []
    if re.fullmatch(r"iteration_\d{1,9}", folder.name) and (own := folder / "point_cloud.ply").is_file():
        return [own]
    found = [*folder.glob("point_cloud/iteration_*/point_cloud.ply"), *folder.glob("ply/point_cloud_*.ply")]
    if folder.name == "point_cloud":
        found += folder.glob("iteration_*/point_cloud.ply")
    return [path for number, path in sorted((_number(path.as_posix()), path) for path in found) if number >= 0]


def _number(name: str) -> int:
    """The step of a trainer's scene, -1 where the name says none."""
    match = _ITERATION.fullmatch(name) or _STEP.fullmatch(name)
    return int(match[1]) if match else -1


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, list[str]]]:
    """The file that holds the scene of a path, there until the end, and a note on how it was found where it is another
    one. Raises InputError where none or several could be meant; errors meanwhile name what was given."""
    if trained := _trained(path):
        last = trained[-1].relative_to(path)
        yield trained[-1], [f"{last} is read, " + (f"the last of {len(trained)}" if len(trained) > 1 else "its scene")]
        return
    start = b""
    if path.is_file():
        with open(path, "rb") as file:
            start = file.read(_PEEK_BYTES)
    if start[:4] == ZIP_MAGIC and (name := _scene_in_zip(path)):
        with _scratch(path, name) as target:
            _unzip(path, name, target)
            yield target, [f"{name} is read, the scene in the ZIP"]
    elif start[:2] == GZIP_MAGIC and (name := _scene_in_gzip(path, start)):
        with _scratch(path, name) as target:
            _gunzip(path, target)
            yield target, []
    else:
        yield path, []


@contextmanager
def _scratch(path: Path, name: str) -> Iterator[Path]:
    """Where a scene is unpacked to. Errors that name that file name what it was unpacked from instead."""
    with scratch_folder() as folder:
        target = folder / f"scene{PurePosixPath(name).suffix.lower()}"
        try:
            yield target
        except InputError as error:
            raise InputError(str(error).replace(str(target), f"{path} ({name})")) from None


def _scene_in_zip(path: Path) -> str | None:
    """The name of the one scene in a ZIP, or the last one of a trainer; None of a SOG. Raises InputError where there is
    none, or several."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if not _is_hidden(name)]
    except BAD_ZIP:
        return None  # the reader of SOG complains
    if any(PurePosixPath(name).name == LOD_META for name in names):
        raise InputError(f"{path} is a streamed SOG in a ZIP; unpack it, and give its {LOD_META}")
    if any(PurePosixPath(name).name == META for name in names):
        return None
    scenes = scenes_among(names)
    if trained := [(number, name) for name in scenes if (number := _number(name)) >= 0]:
        return max(trained)[1]
    if len(scenes) > 1:
        raise InputError(
            f"{path} holds {len(scenes)} scenes ({', '.join(shown(name) for name in scenes[:3])}"
            f"{', ...' if len(scenes) > 3 else ''}); unpack it, and give one of them"
        )
    if scenes:
        return scenes[0]
    if path.suffix.lower() != ".sog":
        _refuse_zip(path, names)
    return None


def _is_hidden(name: str) -> bool:
    """Whether an entry is a folder, or what macOS adds."""
    return name.endswith("/") or any(part.startswith((".", "__MACOSX")) for part in PurePosixPath(name).parts)


def _refuse_zip(path: Path, names: list[str]) -> None:
    """Raises InputError that says what is in a ZIP without a scene, where that is known."""
    ends = [PurePosixPath(name).suffix.lower() for name in names]
    if any(PurePosixPath(name).name == "data.pkl" for name in names):
        refuse_kind(path, CHECKPOINT)
    if names and all(end == ".npy" for end in ends):
        refuse_kind(path, ARRAYS)
    for kind in (USD, GLTF, ARCHIVE):
        if any(end in kind.suffixes for end in ends):
            refuse_kind(f"{path} is a ZIP, and what it holds", kind)
    if any(end in PICTURE_SUFFIXES for end in ends):
        raise InputError(
            f"{path} is a ZIP of {sum(end in PICTURE_SUFFIXES for end in ends)} pictures without a scene; unpack it: "
            "lightfield-gs fit takes the folder of a capture, encode one photo"
        )
    raise InputError(
        f"{path} is a ZIP without a scene ({', '.join(shown(name) for name in names[:3]) or 'it is empty'}); expected "
        f"one file of {', '.join(SCENE_SUFFIXES)}"
    )


def _unzip(path: Path, name: str, target: Path) -> None:
    try:
        with zipfile.ZipFile(path) as archive, archive.open(name) as packed, open(target, "wb") as file:
            info = archive.getinfo(name)
            check_promise(path, info.file_size, info.compress_size)
            shutil.copyfileobj(packed, file, _BLOCK_BYTES)
    except BAD_ZIP as error:
        if isinstance(error, InputError):
            raise
        words = " ".join(str(error).split())[:150]
        raise InputError(f"{path}: cannot unpack {shown(name)} ({words}); download it again") from None


def _scene_in_gzip(path: Path, start: bytes) -> str | None:
    """A name for the scene that gzip has packed; None of an SPZ, which is packed so by itself. Raises InputError where
    it is no scene."""
    if path.suffix.lower() == ".spz" or (inner := gunzip(path, start, _PEEK_BYTES))[:4] == MAGIC:
        return None
    if inner[:2] == GZIP_MAGIC and path.name.lower().endswith(".spz.gz"):
        return "scene.spz"
    if inner[257:262] == b"ustar":
        refuse_kind(path, ARCHIVE)
    if inner[:4] in (b"ply\n", b"ply\r"):
        return "scene.ply"
    if inner[:4] == ZIP_MAGIC:
        return "scene.sog"
    stem = path.stem if path.suffix.lower() == ".gz" else path.name
    if stem.lower().endswith((".splat", ".ksplat")):
        return stem
    raise InputError(f"{path} is packed by gzip, and no scene is in it; unpack it, and see what it holds")


def _gunzip(path: Path, target: Path) -> None:
    """Unpacks gzip data, no further than a file of its size can honestly need. Raises InputError."""
    packer = zlib.decompressobj(zlib.MAX_WBITS | 16)
    left = max(ALWAYS_BYTES, MOST_RATIO * path.stat().st_size)
    try:
        with open(path, "rb") as packed, open(target, "wb") as file:
            block = packed.read(_BLOCK_BYTES)
            while block and not packer.eof:
                data = packer.decompress(block, _BLOCK_BYTES)
                block = packer.unconsumed_tail or packed.read(_BLOCK_BYTES)
                left -= len(data)
                if left < 0:
                    raise InputError(f"{path}: more is packed than a scene of its size can need; it is damaged")
                file.write(data)
            file.write(packer.flush())
    except zlib.error as error:
        raise InputError(f"{path}: its gzip data are broken ({error}); download it again") from None
    if not packer.eof:
        raise InputError(f"{path}: its gzip data end too early; it is cut: download it again")
