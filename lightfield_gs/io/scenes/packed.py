"""Scenes inside another file or folder: in a ZIP, in gzip data, and the last scene in a trainer's folder."""

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
from lightfield_gs.io.file_kinds import (
    ARCHIVE,
    ARRAYS,
    CHECKPOINT,
    PICTURE_SUFFIXES,
    SCENE_SUFFIXES,
    refuse_kind,
    select_scenes,
)
from lightfield_gs.io.scenes.plausibility import MAX_RATIO, MIN_LIMIT_BYTES, check_unpacked_size, gunzip
from lightfield_gs.io.scenes.sog_files import BAD_ZIP, META
from lightfield_gs.io.scenes.spz import GZIP_MAGIC, MAGIC
from lightfield_gs.io.scenes.streamed_sog import LOD_META

ZIP_MAGIC = b"PK\x03\x04"
_ITERATION_NAME = re.compile(
    r"(?:(?:.*/)?point_cloud/)?iteration_(\d{1,9})/point_cloud\.ply"
)  # of 3DGS and its descendants
_STEP_NAME = re.compile(r"(?:.*/)?ply/point_cloud_(\d{1,9})\.ply")  # of gsplat's simple_trainer
_PEEK_BYTES, _BLOCK_BYTES = 512, 1 << 20


def is_packed_scene(path: Path) -> bool:
    """Tell whether `unpack` finds a scene in a path, by its name or by the contents of a folder."""
    name = path.name.lower()
    return name.endswith(tuple(f"{suffix}.gz" for suffix in SCENE_SUFFIXES)) or bool(_trainer_scenes(path))


def _trainer_scenes(folder: Path) -> list[Path]:
    """Return the scenes of a trainer's folder, the last one at the end."""
    if not folder.is_dir():
        return []
    if re.fullmatch(r"iteration_\d{1,9}", folder.name) and (own := folder / "point_cloud.ply").is_file():
        return [own]
    found = [*folder.glob("point_cloud/iteration_*/point_cloud.ply"), *folder.glob("ply/point_cloud_*.ply")]
    if folder.name == "point_cloud":
        found += folder.glob("iteration_*/point_cloud.ply")
    return [path for number, path in sorted((_step(path.as_posix()), path) for path in found) if number >= 0]


def _step(name: str) -> int:
    """Return the step in the name of a trainer's scene, -1 without one."""
    match = _ITERATION_NAME.fullmatch(name) or _STEP_NAME.fullmatch(name)
    return int(match[1]) if match else -1


@contextmanager
def unpack(path: Path) -> Iterator[tuple[Path, list[str]]]:
    """Unpack the scene of a path, and keep it until the end of the context.

    Errors within the context name the path that was given.

    Yields:
        The file with the scene, and a note where it is another file than the given one.

    Raises:
        InputError: there is no scene, or several.
    """
    if trained := _trainer_scenes(path):
        last = trained[-1].relative_to(path)
        yield trained[-1], [f"{last} is read, " + (f"the last of {len(trained)}" if len(trained) > 1 else "its scene")]
        return
    start = b""
    if path.is_file():
        with open(path, "rb") as file:
            start = file.read(_PEEK_BYTES)
    if start[:4] == ZIP_MAGIC and path.suffix.lower() != ".usdz" and (name := _scene_in_zip(path)):
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
    """Yield a temporary path; errors that name it name the packed file instead."""
    with scratch_folder() as folder:
        target = folder / f"scene{PurePosixPath(name).suffix.lower()}"
        try:
            yield target
        except InputError as error:
            raise InputError(str(error).replace(str(target), f"{path} ({name})")) from None


def _scene_in_zip(path: Path) -> str | None:
    """Return the name of the only scene in a ZIP, or of a trainer's last scene; None for a SOG.

    Raises:
        InputError: there is no scene, or several.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if not _is_hidden(name)]
    except BAD_ZIP:
        return None  # the reader of SOG reports it
    if any(PurePosixPath(name).name == LOD_META for name in names):
        raise InputError(f"{path} is a streamed SOG in a ZIP; unpack it, and give its {LOD_META}")
    if any(PurePosixPath(name).name == META for name in names):
        return None
    scenes = select_scenes(names)
    if trained := [(number, name) for name in scenes if (number := _step(name)) >= 0]:
        return max(trained)[1]
    if len(scenes) > 1:
        raise InputError(
            f"{path} holds {len(scenes)} scenes ({', '.join(shown(name) for name in scenes[:3])}"
            f"{', ...' if len(scenes) > 3 else ''}); unpack it, and give one of them"
        )
    if scenes and scenes[0].lower().endswith(".gltf"):
        raise InputError(f"{path} is a ZIP of a .gltf, whose data may be in files beside it; unpack it, and give that")
    if scenes:
        return scenes[0]
    if path.suffix.lower() != ".sog":
        _refuse_zip(path, names)
    return None


def _is_hidden(name: str) -> bool:
    """Tell whether an entry is a folder, or added by macOS."""
    return name.endswith("/") or any(part.startswith((".", "__MACOSX")) for part in PurePosixPath(name).parts)


def _refuse_zip(path: Path, names: list[str]) -> None:
    """Raise InputError that describes the contents of a ZIP without a scene."""
    ends = [PurePosixPath(name).suffix.lower() for name in names]
    if any(PurePosixPath(name).name == "data.pkl" for name in names):
        refuse_kind(path, CHECKPOINT)
    if names and all(end == ".npy" for end in ends):
        refuse_kind(path, ARRAYS)
    if any(end in ARCHIVE.suffixes for end in ends):
        refuse_kind(f"{path} is a ZIP, and what it holds", ARCHIVE)
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
            check_unpacked_size(path, info.file_size, info.compress_size)
            shutil.copyfileobj(packed, file, _BLOCK_BYTES)
    except BAD_ZIP as error:
        if isinstance(error, InputError):
            raise
        words = " ".join(str(error).split())[:150]
        raise InputError(f"{path}: cannot unpack {shown(name)} ({words}); download it again") from None


def _scene_in_gzip(path: Path, start: bytes) -> str | None:
    """Return a name for the scene in gzip data; None for an SPZ, which is gzip data itself.

    Raises:
        InputError: the data are no scene.
    """
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
    """Unpack gzip data, no further than a scene of this size can need; raise InputError."""
    packer = zlib.decompressobj(zlib.MAX_WBITS | 16)
    left = max(MIN_LIMIT_BYTES, MAX_RATIO * path.stat().st_size)
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
