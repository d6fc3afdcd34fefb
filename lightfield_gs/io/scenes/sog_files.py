"""The files of a SOG, in a folder or a ZIP; names, sizes and counts are checked before use."""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from PIL import Image, features

from lightfield_gs.base.checks import shown
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.file_kinds import refuse_stand_in
from lightfield_gs.io.scenes.plausibility import check_unpacked_size
from lightfield_gs.io.text_files import parse_json

META = "meta.json"
_META_BYTES = 1 << 20
_IMAGE_BYTES = 1 << 29
_NAME_LENGTH = 120
BAD_ZIP = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    NotImplementedError,
    RuntimeError,
    ValueError,
    EOFError,
    OverflowError,
    OSError,
)
_BAD_IMAGE = (
    OSError,
    ValueError,
    SyntaxError,
    struct.error,
    Image.DecompressionBombError,
    Image.DecompressionBombWarning,
)
_LOSSY = b"VP8 "  # the chunk of a lossy WebP; a lossless one has VP8L


class SogFiles:
    """The files of a SOG.

    Attributes:
        path: the folder, its meta.json, or the ZIP.
        folder: the folder; None for a ZIP.
        is_lossy: an image read so far is a lossy WebP.

    Raises:
        InputError: the path is no such file.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._zip = path, None
        self.is_lossy = False
        self._prefix = ""
        self.folder: Path | None = None
        if path.is_dir() or path.name.lower() == META:
            self.folder = path if path.is_dir() else path.parent
            return
        try:
            self._zip = zipfile.ZipFile(path)
            names = self._zip.namelist()
        except BAD_ZIP as error:
            refuse_stand_in(path)
            raise InputError(
                f"{path} is no .sog: expected a ZIP of {META} and WebP images ({_words(error)}); it is cut or else"
            ) from None
        if not names:
            raise InputError(f"{path} is an empty ZIP; export it or download it again")
        if META not in names:  # the ZIP of a folder
            inner = [name for name in names if name.endswith("/" + META) and not name.startswith("__MACOSX/")]
            if len(inner) != 1:
                raise InputError(f"{path} is no .sog: the ZIP has no {META}")
            self._prefix = inner[0][: -len(META)]

    def __enter__(self) -> SogFiles:
        return self

    def __exit__(self, *_: Any) -> None:
        if self._zip is not None:
            self._zip.close()

    def meta(self) -> dict[str, Any]:
        """Return the object in meta.json; raise InputError."""
        try:
            text = self._bytes(META, _META_BYTES).decode()
            data = parse_json(text)
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{self.path}: {META} is not JSON: {_words(error)}") from None
        if not isinstance(data, dict):
            raise InputError(f"{self.path}: {META}: expected an object, got {type(data).__name__}")
        return data

    def image(self, name: Any, least: int, width: int | None = None) -> np.ndarray:
        """Read the pixels of an image, row by row.

        Args:
            name: of the image, from meta.json.
            least: smallest number of pixels.
            width: required width, pixels; None for any.

        Returns:
            Red, green, blue and alpha, uint8 [P, 4] with P >= least.
        """
        if not isinstance(name, str) or not _is_plain(name):
            raise InputError(f"{self.path}: {META}: expected the name of a file beside it, got {shown(name)}")
        if not features.check("webp"):
            raise InputError(f"{self.path}: this Pillow reads no WebP; pip install --force-reinstall pillow")
        data = self._bytes(name, _IMAGE_BYTES)
        self.is_lossy |= data[:4] == b"RIFF" and data[12:16] == _LOSSY
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with Image.open(io.BytesIO(data), formats=("WEBP", "PNG")) as image:
                    self._check_size(name, image.size, least, width, len(data))
                    return np.asarray(image.convert("RGBA")).reshape(-1, 4)
        except _BAD_IMAGE as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{self.path}: cannot read the image {shown(name)} ({_words(error)})") from None

    def _check_size(self, name: str, size: tuple[int, int], least: int, width: int | None, stored: int) -> None:
        pixels = size[0] * size[1]
        if pixels < least or width not in (None, size[0]):
            wanted = f"{least} pixels or more" + ("" if width is None else f", {width} of them in a row")
            raise InputError(
                f"{self.path}: {shown(name)} has {size[0]} x {size[1]} pixels, expected {wanted}; wrong image or count"
            )
        check_unpacked_size(self.path, 4 * pixels, stored)

    def _bytes(self, name: str, most_bytes: int) -> bytes:
        if self.folder is not None:
            data = _read(self.folder / name, most_bytes)
        else:
            data = self._unpacked(self._prefix + name, most_bytes)
        if len(data) > most_bytes:
            raise InputError(f"{self.path}: {shown(name)} has more than {most_bytes} bytes; this is no SOG")
        return data

    def _unpacked(self, name: str, most_bytes: int) -> bytes:
        assert self._zip is not None
        try:
            info = self._zip.getinfo(name)
        except KeyError:
            raise InputError(f"{self.path}: the ZIP has no {shown(name)}") from None
        check_unpacked_size(self.path, min(info.file_size, most_bytes + 1), info.compress_size)
        try:
            with self._zip.open(info) as file:
                return file.read(most_bytes + 1)
        except BAD_ZIP as error:
            raise InputError(f"{self.path}: cannot unpack {shown(name)} ({_words(error)}); download it again") from None


def _is_plain(name: str) -> bool:
    """Tell whether it is the name of a file, and no path to another folder."""
    return (
        PurePosixPath(name).name == name and "\\" not in name and name not in ("", "..") and len(name) <= _NAME_LENGTH
    )


def _read(path: Path, most_bytes: int) -> bytes:
    with reading(path), open(checked_path(path), "rb") as file:
        return file.read(most_bytes + 1)


def _words(error: BaseException) -> str:
    return " ".join(str(error).split())[:150]
