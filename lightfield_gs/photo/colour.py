"""The colours of an image file, by its profile, gamma or format, converted to sRGB."""

from __future__ import annotations

import io
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from lightfield_gs.base.arrays import encode_srgb
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.images import Picture, as_floats
from lightfield_gs.photo.image_filters import row_strips

_LINEAR_FORMATS = ("openexr", "hdr")
_SRGB_GAMMA = 2.2


@dataclass(frozen=True)
class ColourConstants:
    """Tolerances of the conversion to sRGB.

    All are chosen by hand and not tuned on a data set; tests/photo has the pictures that they must tell apart.
    """

    same_gamma: float = 0.1  # difference of gammas below which a file counts as sRGB
    same_levels: int = 2  # largest difference, of 255 levels over all colours, of a profile that counts as sRGB
    clipped_fraction: float = 0.001  # fraction of the pixels brighter than 1 from which on a note says so


_C = ColourConstants()

# Codes of ITU-T H.273 that count as sRGB: primaries of BT.709, transfer functions of BT.709 and sRGB; 2: unspecified
_SRGB_CICP = (1, 2), (1, 2, 6, 13)
_SRGB_PRIMARIES = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06)  # x and y of red, green and blue
_UNCALIBRATED = 65535  # Exif's ColorSpace of other colours than sRGB; in cameras, Adobe RGB
_STRIP_PIXELS = 1 << 20  # converted at a time: Pillow keeps four bytes a pixel beside input and output
_MOST_PIXELS = 1 << 24  # of a picture that stays in floating point; larger ones are converted to 8 bits
_MOST_THREADS = 4


@dataclass
class Colours:
    """Colours in sRGB.

    Attributes:
        pixels: [H, W, 3], uint8 or float32 in 0..1.
        description: The conversion; empty for none.
        notes: Doubts about the colours.
    """

    pixels: np.ndarray
    description: str = ""
    notes: list[str] = field(default_factory=list)


def to_srgb(rgb: np.ndarray, picture: Picture) -> Colours:
    """Convert the colours of a picture to sRGB.

    Its ICC profile counts, which lcms applies in 8 bits, or else its gamma (PNG); EXR and Radiance files are linear.
    Anything else counts as sRGB, with a note.

    Args:
        rgb: [H, W, 3], or [H, W, 1] of a grey picture.
        picture: The picture with its metadata.
    """
    gamma, linear = picture.colour.get("oiio:Gamma", _SRGB_GAMMA), is_linear(picture)
    if "ICCProfile" in picture.colour:
        was_cmyk = picture.colour.get("jpeg:ColorSpace") == "CMYK"
        colours = _convert_profile(rgb, bytes(picture.colour["ICCProfile"]), was_cmyk)
    elif linear or abs(gamma - _SRGB_GAMMA) > _C.same_gamma:
        colours = _convert_gamma(rgb, 1.0 if linear else gamma)
    else:
        colours = Colours(rgb, notes=_plausibility_notes(rgb, picture))
    if "ICCProfile" not in picture.colour:
        primaries = picture.colour.get("chromaticities", _SRGB_PRIMARIES)
        if not np.allclose(primaries[:6], _SRGB_PRIMARIES, atol=0.005):
            colours.notes.append("has other primary colours than sRGB, which are taken for those; export it as sRGB")
    if colours.pixels.dtype != np.uint8 and colours.pixels[..., 0].size > _MOST_PIXELS:
        colours.pixels = _to_bytes(colours.pixels)
        colours.description += f"{colours.description and ', '}taken in 8 bits for its size"
    elif colours.pixels.dtype != np.uint8:
        colours.pixels = np.clip(as_floats(colours.pixels), 0, 1)
    if colours.pixels.shape[2] == 1:
        colours.pixels = np.repeat(colours.pixels, 3, 2)
    return colours


def check_finite(picture: Picture, path: object) -> None:
    """Raise InputError where a pixel of the file `path` is NaN or infinite."""
    if picture.pixels.dtype == np.float32 and not np.isfinite(picture.pixels).all():
        raise InputError(f"{path} has pixels that are not finite; export it as 8- or 16-bit")


def is_linear(picture: Picture) -> bool:
    """Return whether the samples of a picture are in proportion to light, by its format or metadata."""
    space = str(picture.colour.get("oiio:ColorSpace", ""))
    return picture.colour.get("format") in _LINEAR_FORMATS or space.startswith("lin_")


def _plausibility_notes(rgb: np.ndarray, picture: Picture) -> list[str]:
    """Return notes on a picture without a profile."""
    cicp = tuple(picture.colour.get("CICP", ()))[:2]
    if any(value not in usual for value, usual in zip(cicp, _SRGB_CICP)):
        return [
            f"says that its colours are of another kind (CICP {cicp[0]}/{cicp[1]}, of wide gamut or HDR), and they "
            "are taken as sRGB; export it as sRGB"
        ]
    if picture.colour.get("Exif:ColorSpace") == _UNCALIBRATED:
        return [
            "says that its colours are not sRGB, perhaps Adobe RGB, and holds no profile; they are taken as sRGB; "
            "export it with its profile, or as sRGB"
        ]
    if rgb.dtype == np.float32:
        return [
            "holds floating point without a profile, which is taken as sRGB is encoded; save it as .exr if it is linear"
        ]
    return []


def _convert_gamma(rgb: np.ndarray, gamma: float) -> Colours:
    values = as_floats(rgb)
    bright = float((values > 1).any(2).mean())
    linear = np.clip(values, 0, 1) ** np.float32(gamma)
    encoded = encode_srgb(linear)
    notes = [f"is brighter than white on {bright:.1%} of its pixels, which are clipped; expose it less"]
    description = "linear, encoded as sRGB" if gamma == 1 else f"gamma {gamma:.3g}, converted to sRGB"
    return Colours(encoded.astype(np.float32), description, notes if bright > _C.clipped_fraction else [])


def _convert_profile(rgb: np.ndarray, profile: bytes, was_cmyk: bool) -> Colours:
    from PIL import Image, ImageCms

    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = _printable(ImageCms.getProfileDescription(source))
        space = source.profile.xcolor_space.strip()
        mode = {"RGB": "RGB", "GRAY": "L"}.get(space)
        if mode is None or was_cmyk:
            note = (
                f"has a colour profile for {space} ('{name}'), which cannot be used here; its colours are only about "
                "right; export it as RGB"
            )
            return Colours(rgb, notes=[note])
        # Each thread needs its own transform, because a transform caches the last colour
        how = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
        transforms = [
            ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB", *how)
            for _ in range(min(os.cpu_count() or 1, _MOST_THREADS))
        ]
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError, AttributeError) as error:
        note = f"has a colour profile that cannot be read ({_printable(str(error))}); its colours are taken as sRGB"
        return Colours(rgb, notes=[note])

    def apply(block: np.ndarray, transform: ImageCms.ImageCmsTransform) -> np.ndarray:
        block = block[..., 0] if mode == "L" else block
        return np.asarray(ImageCms.applyTransform(Image.fromarray(np.ascontiguousarray(block)), transform))

    if mode == "L" and rgb.shape[2] == 3:
        rgb = rgb[..., :1]
    probe = _probe_colours(mode)
    if np.abs(apply(probe, transforms[0]).astype(int) - probe).max() <= _C.same_levels:
        return Colours(rgb)
    pixels, rows = np.empty((*rgb.shape[:2], 3), np.uint8), list(row_strips(rgb.shape[0], rgb.shape[1], _STRIP_PIXELS))

    def convert(thread: int) -> None:
        for top, bottom in rows[thread :: len(transforms)]:
            pixels[top:bottom] = apply(_to_bytes(rgb[top:bottom]), transforms[thread])

    with ThreadPoolExecutor(len(transforms)) as pool:  # lcms works outside the interpreter lock
        list(pool.map(convert, range(len(transforms))))
    return Colours(pixels, f"profile '{name}' converted to sRGB" + ("" if rgb.dtype == np.uint8 else " in 8 bits"))


def _probe_colours(mode: str) -> np.ndarray:
    """Return colours from all over the cube, or all greys (mode "L"), [1, N, 3 or 1] uint8."""
    if mode == "L":
        return np.arange(256, dtype=np.uint8)[None, :, None]
    levels = np.linspace(0, 255, 9).round().astype(np.uint8)
    return np.stack(np.meshgrid(levels, levels, levels), -1).reshape(1, -1, 3)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    if values.dtype == np.uint8:
        return values
    rounded = np.empty(values.shape, np.uint8)
    for top, bottom in row_strips(values.shape[0], values.shape[1], _STRIP_PIXELS):
        rounded[top:bottom] = np.rint(np.clip(as_floats(values[top:bottom]), 0, 1) * 255)
    return rounded


def _printable(text: str) -> str:
    """Return the beginning of a text from a file, on one line."""
    return "".join(c if c.isprintable() else " " for c in " ".join(text.split()))[:60].strip() or "no name"
