"""Photographs of a capture: files that can be read, decoded on demand, undistorted and reduced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.captures.camera_models import Lens
from lightfield_gs.io.captures.photo_files import RAW_SUFFIXES, Places, too_few
from lightfield_gs.io.captures.undistortion import Straightening, reduced, resampled, straightening
from lightfield_gs.io.images import read_image, read_info

_END_BYTES = 64  # of a file that are looked at
# Formats by their first bytes, and what the last bytes of a whole file hold
_ENDS = ((b"\xff\xd8\xff", b"\xff\xd9"), (b"\x89PNG\r\n\x1a\n", b"IEND"))
_BOXES = b"ftyp"  # at byte 4 of HEIC and AVIF, whose boxes say how long they are
_LINEAR_SUFFIXES = (".exr", ".hdr")


@dataclass(frozen=True)
class Shot:
    """A photograph and its camera, as a layout has them; nothing is decoded yet.

    name: relative to the folder of images, with / between folders. world_to_camera: [4,4] float64, OpenCV axes.
    intrinsics: [4] float64, (fx, fy, cx, cy) in pixels of a picture of camera_px (width, height), from the outer
    corner of the first; the file at `path` may be another size. lens: None for a pinhole. mask: where the layout names
    one.
    """

    name: str
    path: Path
    world_to_camera: np.ndarray
    intrinsics: np.ndarray
    camera_px: tuple[int, int]
    lens: Lens | None = None
    mask: Path | None = None


@dataclass(frozen=True)
class Shots:
    """A capture as its layout has it. source: the file or folder that says so, for messages. images: the folder that
    names are relative to. points: [P,3] float64; colours: [P,3] uint8. held_out: names of the photographs that it keeps
    for tests itself; held_by: what says so."""

    source: Path
    images: Path
    shots: list[Shot]
    points: np.ndarray
    colours: np.ndarray
    held_out: tuple[str, ...] = ()
    held_by: str = ""


@dataclass(frozen=True)
class Photograph:
    """A file and what is done to it.

    stored_px: width and height of the file. size_px: of what image() and mask() give. intrinsics: (fx, fy, cx, cy) in
    pixels of the file. mask_path: of a picture in which white counts. alpha: whether the file has an alpha channel.
    orientation: the Exif orientation 1..8 of the file, which none of these is turned by.
    """

    path: Path
    stored_px: tuple[int, int]
    size_px: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    lens: Lens | None = None
    mask_path: Path | None = None
    alpha: bool = False
    orientation: int = 1

    def image(self) -> np.ndarray:
        """Colours uint8 [H,W,3] as the file has them (sRGB), undistorted; those of transparent pixels bleed into no
        edge. Raises InputError."""
        return resampled(self._pixels(), self._straightening(), *self.size_px)

    def mask(self) -> np.ndarray | None:
        """What counts, uint8 [H,W]: 255 yes, 0 no, between them at edges; None where all does. It is the least of the
        mask's file, the photograph's alpha and the frame of the distorted photograph. Raises InputError."""
        return self._least([*self._opaque_parts(), *self._frame_parts()])

    def opacity(self) -> np.ndarray | None:
        """As mask, of the mask's file and the alpha alone. What it says beyond the frame means nothing."""
        return self._least(self._opaque_parts())

    def frame(self) -> np.ndarray | None:
        """As mask, of the frame of the distorted photograph alone."""
        return self._least(self._frame_parts())

    def _opaque_parts(self) -> list[np.ndarray]:
        """What the mask's file and the alpha say, undistorted."""
        parts = []
        if self.mask_path is not None:
            parts.append(read_mask(self.mask_path, *self.stored_px, any_size=True))
        if self.alpha:
            parts.append(self._pixels()[..., 3])
        lens = self._straightening()
        return parts if lens is None else [lens(part) for part in parts]

    def _frame_parts(self) -> list[np.ndarray]:
        """Where the distorted photograph ends, if it does."""
        lens = self._straightening()
        return [] if lens is None or lens.frame is None else [lens.frame]

    def _least(self, parts: list[np.ndarray]) -> np.ndarray | None:
        """The least of masks [H,W] of the file's size, as small as is wanted; None where all is 255."""
        if not parts:
            return None
        mask = np.minimum.reduce(parts)
        return None if mask.min() == 255 else reduced(mask, *self.size_px)

    def _straightening(self) -> Straightening | None:
        return None if self.lens is None else straightening(self.lens, self.intrinsics, *self.stored_px)

    def _pixels(self) -> np.ndarray:
        """The file's pixels uint8 [H,W,3 or 4] as stored, which poses refer to, whatever Exif says."""
        pixels = read_image(self.path, as_stored=True, turn=False)
        if pixels.shape[1::-1] != self.stored_px:
            raise InputError(f"{self.path}: was changed since it was found: expected {self.stored_px}")
        if pixels.dtype == np.float32 and is_linear(self.path):
            pixels = _encoded(pixels, self.alpha)
        if pixels.dtype == np.uint16:
            pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
        if pixels.dtype != np.uint8:
            raise InputError(f"{self.path}: expected a photograph of 8 or 16 bits a channel, got {pixels.dtype}")
        if pixels.shape[2] < 3:  # grey, with or without alpha
            pixels = np.concatenate([np.repeat(pixels[..., :1], 3, 2), pixels[..., 1:]], 2)
        return pixels


def _encoded(pixels: np.ndarray, alpha: bool) -> np.ndarray:
    """Linear light [H,W,C] as uint8: sRGB, and alpha, where it has that, as it is; further channels are left out."""
    colours = 1 if pixels.shape[2] < 3 else 3
    pixels = np.nan_to_num(pixels[..., : colours + alpha], posinf=1.0).clip(0, 1)
    pixels[..., :colours] = encode_srgb(pixels[..., :colours])
    return np.rint(255 * pixels).astype(np.uint8)


def read_mask(path: Path, width_px: int, height_px: int, any_size: bool = False) -> np.ndarray:
    """A mask as opacity, uint8 [H,W]: its alpha, or else its brightness; of values 0 and 1 alone, 1 is opaque.

    Its pixels as stored, like those of the image. Raises InputError for another size than the image's; any_size: then
    each pixel of the image has what the mask says at its middle.
    """
    pixels = read_image(path, as_stored=True, turn=False)
    if any_size:
        rows, columns = (
            (2 * np.arange(size) + 1) * stored // (2 * size)
            for size, stored in zip((height_px, width_px), pixels.shape[:2])
        )
        pixels = pixels[rows[:, None], columns]
    if pixels.shape[:2] != (height_px, width_px):
        raise InputError(
            f"{path}: expected a mask of the image's size {width_px} x {height_px}, got "
            f"{pixels.shape[1]} x {pixels.shape[0]}"
        )
    full = np.iinfo(pixels.dtype).max if pixels.dtype.kind == "u" else 1
    has_alpha = pixels.shape[2] in (2, 4) and pixels[..., -1].min() < full
    grey = pixels[..., -1] if has_alpha else pixels[..., : 1 if pixels.shape[2] < 3 else 3].mean(-1)
    if grey.max() <= 1:
        full = 1
    return np.rint(255 * np.clip(grey / full, 0, 1)).astype(np.uint8)


def readable(places: Places, images: Path) -> Places:
    """Those of these photographs that can be read; says which are left out, and that linear ones are encoded.

    Args:
        places: where they are.
        images: the folder that they are in, for messages.

    Raises InputError where too few can be read, with the reason of the first.
    """
    left, reasons = {}, []
    for name, place in places.items():
        try:
            _check(place[1])
        except InputError as error:
            reasons.append(str(error))
        else:
            left[name] = place
    if reasons:
        share = len(reasons), "photograph", len(places)
        if too_few(len(left), len(places)):
            raise InputError(f"{images}: {counted(*share, 'cannot be read')}: {reasons[0]}")
        assume(f"{counted(*share, 'cannot be read and are left out')}: {reasons[0]}")
    if linear := [name for name, path in left.values() if is_linear(path)]:
        assume(
            f"{len(linear)} of {len(places)} photographs hold linear light, as {linear[0]}: it is encoded as sRGB, and "
            "what is brighter than 1 is white"
        )
    return left


def is_linear(path: Path) -> bool:
    """Whether a picture of this name holds linear light, by its format."""
    return path.suffix.lower() in _LINEAR_SUFFIXES


def _check(path: Path) -> None:
    """Raises InputError for a file that is no whole photograph; what looks whole at its end is not decoded."""
    if path.suffix.lower() in RAW_SUFFIXES:
        raise InputError(
            f"{path} is a camera's raw file, a kind that is not read: export the photographs as JPEG, PNG or TIFF of "
            "the size that was posed"
        )
    read_info(path)
    if not _ends_well(path):
        read_image(path, as_stored=True, turn=False)


def _ends_well(path: Path) -> bool:
    """Whether a file ends as whole ones of its format do; false where that cannot be told."""
    with reading(path), path.open("rb") as file:
        start = file.read(16)
        size = file.seek(0, 2)
        if start[4:8] == _BOXES:
            return _last_box_ends(path, size)
        file.seek(max(0, size - _END_BYTES))
        end = file.read()
    if start[:4] == b"RIFF":  # WebP
        return 8 + int.from_bytes(start[4:8], "little") <= size
    return any(start.startswith(begin) and last in end[-2 if len(last) == 2 else 0 :] for begin, last in _ENDS)


def _last_box_ends(path: Path, size: int) -> bool:
    """Whether the boxes of a HEIC or AVIF (ISO/IEC 14496-12, section 4.2) end where the file does, or before."""
    at = 0
    with reading(path), path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            if length == 0:  # as far as the file goes
                return True
            if length < 8:
                return False
            at += length
    return at <= size
