"""One photograph of a capture: decoded when it is asked for, without its lens, as small as is wanted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_models import Lens
from lightfield_gs.io.captures.masks import read_mask
from lightfield_gs.io.captures.readable import is_linear
from lightfield_gs.io.captures.resampling import Straightening, reduced, resampled, straightening
from lightfield_gs.io.images import read_image


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
