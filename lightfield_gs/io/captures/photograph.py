"""Photographs of a capture: files that can be read, decoded on demand, undistorted and reduced."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import counted
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.options import CameraModel
from lightfield_gs.io.captures.camera_models import Distortion
from lightfield_gs.io.captures.photo_files import RAW_SUFFIXES, LocatedFiles, is_too_few
from lightfield_gs.io.captures.undistortion import Undistortion, reduced, resampled, undistortion
from lightfield_gs.io.images import read_image, read_info

_END_BYTES = 64  # inspected at the end of a file
# First bytes of a format, and the last bytes of a complete file
_ENDS = ((b"\xff\xd8\xff", b"\xff\xd9"), (b"\x89PNG\r\n\x1a\n", b"IEND"))
_BOXES = b"ftyp"  # at byte 4 of HEIC and AVIF, whose boxes say how long they are
_LINEAR_SUFFIXES = (".exr", ".hdr")
Half = Literal["ahead", "behind"]


@dataclass(frozen=True)
class PosedPhotograph:
    """A photograph and its camera, as a layout has them; nothing is decoded yet.

    Attributes:
        name: relative to the folder of images, with / between folders.
        path: its file, which may have another size than camera_px.
        world_to_camera: [4,4] float64, OpenCV axes.
        intrinsics: [4] float64, (fx, fy, cx, cy) in pixels of an image of camera_px, from the outer corner of the
            first.
        camera_px: width and height.
        distortion: of the lens; None for a pinhole.
        mask: the file that the layout names, if it names one.
        border_px: rows and columns at each edge of the file that show nothing.
        half: of an equirectangular file, which has twice as many columns; see Photograph.
        readout: [2,3], turn and way of the camera while its rolling shutter reads; see Capture.
    """

    name: str
    path: Path
    world_to_camera: np.ndarray
    intrinsics: np.ndarray
    camera_px: tuple[int, int]
    distortion: Distortion | None = None
    mask: Path | None = None
    border_px: int = 0
    half: Half | None = None
    readout: np.ndarray | None = None


@dataclass(frozen=True)
class PosedCapture:
    """A capture as its layout has it.

    Attributes:
        source: the file or folder with the cameras, for messages.
        images: the folder that names are relative to.
        photographs: in any order.
        points: [P,3] float64.
        colours: [P,3] uint8.
        held_out: names of the photographs that the capture itself holds out for tests.
        held_by: the file or field that holds them out.
    """

    source: Path
    images: Path
    photographs: list[PosedPhotograph]
    points: np.ndarray
    colours: np.ndarray
    held_out: tuple[str, ...] = ()
    held_by: str = ""


@dataclass(frozen=True)
class Photograph:
    """A file, and how it is undistorted and reduced.

    Attributes:
        path: the file.
        stored_px: width and height of the file, or of the half of it.
        size_px: width and height of image() and mask().
        intrinsics: (fx, fy, cx, cy) in pixels of the file.
        distortion: of the lens; None for a pinhole.
        mask_path: an image that is white where the photograph counts.
        alpha: whether the file has an alpha channel.
        orientation: Exif orientation of the file, 1..8. Images are never turned by it.
        border_px: rows and columns at each edge of the file that show nothing.
        model: of the camera that undistorted images are by; a fisheye is an equidistant one.
        half: the part of an equirectangular file of 360 degrees that the photograph is: within 90 degrees of the
            middle to either side, or the rest. None: all of the file.
    """

    path: Path
    stored_px: tuple[int, int]
    size_px: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    distortion: Distortion | None = None
    mask_path: Path | None = None
    alpha: bool = False
    orientation: int = 1
    border_px: int = 0
    model: CameraModel = "pinhole"
    half: Half | None = None

    def image(self) -> np.ndarray:
        """Decode the colours, uint8 [H,W,3], sRGB, undistorted and reduced.

        Colours of transparent pixels bleed into no edge. Raises InputError.
        """
        return resampled(self._pixels(), self._undistortion(), *self.size_px)

    def mask(self) -> np.ndarray | None:
        """Return the mask, uint8 [H,W]: 255 where the photograph counts, 0 where not; None where all counts.

        It is the least of the mask's file, the alpha and the valid area. Raises InputError.
        """
        return self._minimum([*self._opacity_masks(), *self._valid_areas()])

    @property
    def may_be_masked(self) -> bool:
        """Whether mask() may return one."""
        return self.mask_path is not None or self.alpha or self.border_px > 0 or self.distortion is not None

    def opacity(self) -> np.ndarray | None:
        """Return the mask of the mask's file and the alpha alone. Beyond the valid area it is undefined."""
        return self._minimum(self._opacity_masks())

    def valid_area(self) -> np.ndarray | None:
        """Return the mask of the distorted photograph's frame alone."""
        return self._minimum(self._valid_areas())

    def _opacity_masks(self) -> list[np.ndarray]:
        """Return the mask's file and the alpha, undistorted."""
        parts = []
        if self.mask_path is not None:
            parts.append(self._part(read_mask(self.mask_path, *self._file_px, any_size=True)))
        if self.alpha:
            parts.append(self._pixels()[..., 3])
        undistort = self._undistortion()
        return parts if undistort is None else [undistort(part) for part in parts]

    def _valid_areas(self) -> list[np.ndarray]:
        """Return the area within the distorted photograph, and within its border, unless that is all."""
        undistort = self._undistortion()
        areas = [] if undistort is None or undistort.valid_area is None else [undistort.valid_area]
        if (border := self.border_px) > 0:
            inside = np.zeros(self.stored_px[::-1], np.uint8)
            inside[border:-border, border:-border] = 255
            areas.append(inside if undistort is None else undistort(inside))
        return areas

    def _minimum(self, parts: list[np.ndarray]) -> np.ndarray | None:
        """Return the least of masks [H,W] of the file's size, reduced; None where all is 255."""
        if not parts:
            return None
        mask = np.minimum.reduce(parts)
        return None if mask.min() == 255 else reduced(mask, *self.size_px)

    def _undistortion(self) -> Undistortion | None:
        fisheye = self.model == "fisheye"
        if self.distortion is None or (fisheye and not any(self.distortion.coefficients)):
            return None
        return undistortion(self.distortion, self.intrinsics, *self.stored_px, fisheye)

    @property
    def _file_px(self) -> tuple[int, int]:
        width, height = self.stored_px
        return (width, height) if self.half is None else (2 * width, height)

    def _part(self, pixels: np.ndarray) -> np.ndarray:
        """Return the part of a picture [H,W,...] of the file that the photograph is."""
        if self.half is None:
            return pixels
        quarter = pixels.shape[1] // 4
        first = quarter if self.half == "ahead" else 3 * quarter
        return np.roll(pixels, -first, 1)[:, : 2 * quarter]

    def _pixels(self) -> np.ndarray:
        """Decode the file as stored, whatever its Exif: uint8 [H,W,3 or 4]. Poses refer to these pixels."""
        pixels = read_image(self.path, as_stored=True, turn=False)
        if pixels.shape[1::-1] != self._file_px:
            raise InputError(f"{self.path}: was changed since it was found: expected {self._file_px}")
        pixels = self._part(pixels)
        if pixels.dtype == np.float32 and is_linear(self.path):
            pixels = _encode_srgb(pixels, self.alpha)
        if pixels.dtype == np.uint16:
            pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
        if pixels.dtype != np.uint8:
            raise InputError(f"{self.path}: expected a photograph of 8 or 16 bits a channel, got {pixels.dtype}")
        if pixels.shape[2] < 3:  # grey, with or without alpha
            pixels = np.concatenate([np.repeat(pixels[..., :1], 3, 2), pixels[..., 1:]], 2)
        return pixels


def _encode_srgb(pixels: np.ndarray, alpha: bool) -> np.ndarray:
    """Encode linear light [H,W,C] as sRGB, uint8; alpha stays linear, further channels are left out."""
    colours = 1 if pixels.shape[2] < 3 else 3
    pixels = np.nan_to_num(pixels[..., : colours + alpha], posinf=1.0).clip(0, 1)
    pixels[..., :colours] = encode_srgb(pixels[..., :colours])
    return np.rint(255 * pixels).astype(np.uint8)


def read_mask(path: Path, width_px: int, height_px: int, any_size: bool = False) -> np.ndarray:
    """Read a mask as opacity: its alpha, or else its brightness. Where all values are 0 or 1, 1 is opaque.

    Args:
        path: the file. Its pixels count as stored, whatever its Exif.
        width_px, height_px: size of the image.
        any_size: resample a mask of another size, to the nearest pixel.

    Returns:
        uint8 [H,W].

    Raises:
        InputError: for another size than the image's, unless any_size.
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


def readable_files(files: LocatedFiles, images: Path) -> LocatedFiles:
    """Return the photographs that can be read, so that a broken download is found before a fit begins.

    Unreadable files are noted, and that linear images are encoded.

    Args:
        files: the photographs.
        images: their folder, for messages.

    Raises:
        InputError: where too few can be read, with the reason of the first.
    """
    readable, reasons = {}, []
    for name, file in files.items():
        try:
            _check(file[1])
        except InputError as error:
            reasons.append(str(error))
        else:
            readable[name] = file
    if reasons:
        counts = len(reasons), "photograph", len(files)
        if is_too_few(len(readable), len(files)):
            raise InputError(f"{images}: {counted(*counts, 'cannot be read')}: {reasons[0]}")
        assume(f"{counted(*counts, 'cannot be read and are left out')}: {reasons[0]}")
    if linear := [name for name, path in readable.values() if is_linear(path)]:
        assume(
            f"{len(linear)} of {len(files)} photographs hold linear light, as {linear[0]}: it is encoded as sRGB, and "
            "what is brighter than 1 is white"
        )
    return readable


def is_linear(path: Path) -> bool:
    """Return whether images of this format hold linear light."""
    return path.suffix.lower() in _LINEAR_SUFFIXES


def _check(path: Path) -> None:
    """Raise InputError for a file that is no whole photograph. A file with a complete end is not decoded."""
    if path.suffix.lower() in RAW_SUFFIXES:
        raise InputError(
            f"{path} is a camera's raw file, a kind that is not read: export the photographs as JPEG, PNG or TIFF of "
            "the size that was posed"
        )
    read_info(path)
    if not _is_complete(path):
        read_image(path, as_stored=True, turn=False)


def _is_complete(path: Path) -> bool:
    """Return whether a file ends as whole files of its format do; False where that is unknown."""
    with reading(path), path.open("rb") as file:
        start = file.read(16)
        size = file.seek(0, 2)
        if start[4:8] == _BOXES:
            return _has_complete_boxes(path, size)
        file.seek(max(0, size - _END_BYTES))
        end = file.read()
    if start[:4] == b"RIFF":  # WebP
        return 8 + int.from_bytes(start[4:8], "little") <= size
    return any(start.startswith(begin) and last in end[-2 if len(last) == 2 else 0 :] for begin, last in _ENDS)


def _has_complete_boxes(path: Path, size: int) -> bool:
    """Return whether the boxes of a HEIC or AVIF (ISO/IEC 14496-12, section 4.2) end within the file."""
    at = 0
    with reading(path), path.open("rb") as file:
        while at + 8 <= size:
            file.seek(at)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            if length == 0:  # the box extends to the end of the file
                return True
            if length < 8:
                return False
            at += length
    return at <= size
