"""Reading and writing of images through OpenImageIO.

PNG (8 and 16 bit), EXR and TIFF are written; all formats of OpenImageIO, AVIF and HEIC are read.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.options import Compression
from lightfield_gs.io.atomic import atomic_path, check_output_path, checked_path
from lightfield_gs.io.file_kinds import refuse_large_non_image, refuse_non_image, refuse_unsupported, refuse_video
from lightfield_gs.io.pillow_images import decode_heif, heif_orientation, is_heif, open_heif
from lightfield_gs.io.png import CompressedImage, png_colour, png_damage, write_png
from lightfield_gs.io.text_files import parse_json

MAX_SIDE_PX = 65536
MAX_PIXELS = 1 << 28  # nine 8K frames: more is a mistake or an attack
_MOST_CHANNELS, _MOST_LAYERS = 16, 1024  # of an image, and of an EXR of which one channel is read
# Limits of a file's size in memory: a multiple of its size, or bytes. Deflate reaches 1030 on a plain image.
_MOST_EXPANSION, _SMALL_BYTES = 2000, 64 << 20
_COLOUR_ATTRIBUTES = (
    "ICCProfile",
    "oiio:ColorSpace",
    "oiio:Gamma",
    "CICP",
    "chromaticities",
    "Exif:ColorSpace",
    "jpeg:ColorSpace",
    "oiio:UnassociatedAlpha",
)
_MAYBE_ASSOCIATED = ("tiff", "openexr")  # alpha may be premultiplied in these formats; in all others it is straight
_METADATA_KEY = "ImageDescription"  # the one text field that PNG, EXR and TIFF all keep
_PNG_KEYWORDS = {_METADATA_KEY: "Description"}  # keywords that OpenImageIO names differently
_DTYPES = {
    ".png": ("uint8", "uint16"),
    ".exr": ("float32",),
    ".tif": ("uint8", "uint16", "float32"),
    ".tiff": ("uint8", "uint16", "float32"),
}
# Neighbours in a row of a panel's image belong to different views. Nothing repeats except plain areas, which are runs,
# and the pixel above is often of the same view. "fast" exploits both (io/png.py). Ordinary images become smaller with
# the best filter for each row ("small").
# Measured on 8K frames of a photo's object and of a whole photo, on one core:
#   PNG, uncompressed                         0.2 s              89 MB
#   PNG, filter Up and runs, zlib level 1     0.6 and 1.0 s      12 and 31 MB ("fast" takes a third of the time: ISA-L)
#   PNG, no filter, zlib level 1              0.6 and 1.4 s      16 and 38 MB
#   PNG, no filter, zlib level 6              1.2 and 2.2 s      15 and 37 MB
#   EXR, uncompressed 0.5 s, zip 1.7 s; TIFF, uncompressed 0.1 s, zip 7 s
_PNG_FILTER_ANY = 0xF8
_SETTINGS: dict[Compression, dict[str, dict[str, int | str]]] = {
    "fast": {
        ".png": {},  # see io/png.py
        ".exr": {"compression": "none"},
        ".tif": {"compression": "none"},
        ".tiff": {"compression": "none"},
    },
    "small": {
        ".png": {"png:compressionLevel": 6, "compression": "rle", "png:filter": _PNG_FILTER_ANY},
        ".exr": {"compression": "zip"},
        ".tif": {"compression": "zip"},
        ".tiff": {"compression": "zip"},
    },
}


@dataclass
class ImageInfo:
    """Header of an image file.

    Attributes:
        width_px, height_px: size as stored.
        channels: number of channels.
        sample_type: OpenImageIO's name of the type.
        metadata: metadata of this package.
        orientation: Exif orientation 1..8.
        has_alpha: the last of 2 or 4 channels is alpha; in an EXR it may be depth.
    """

    width_px: int
    height_px: int
    channels: int
    sample_type: str
    metadata: dict[str, str] = field(default_factory=dict)
    orientation: int = 1
    has_alpha: bool = False


@dataclass(frozen=True)
class Picture:
    """The contents of an image file.

    Attributes:
        pixels: [H, W, C], straight alpha; uint8, uint16 or float32 as in the file.
        orientation: Exif orientation 1..8 of the file.
        colour: colour space by OpenImageIO's names, such as "ICCProfile" (bytes) and "oiio:ColorSpace", and the file's
            "format".
    """

    pixels: np.ndarray
    orientation: int = 1
    colour: dict[str, Any] = field(default_factory=dict)


def check_image_path(path: str | Path) -> Path:
    """Return `path` if an image can be written there; raise InputError, before any long work is done in vain."""
    path = check_output_path(path)
    if path.suffix.lower() not in _DTYPES:
        raise InputError(
            f"cannot write {path}: expected the extension {', '.join(_DTYPES)}, got '{path.suffix}' "
            "(lossy formats would mix the views)"
        )
    return path


def write_image(
    path: str | Path,
    array: np.ndarray | CompressedImage,
    metadata: dict[str, str] | None = None,
    compression: Compression = "fast",
) -> None:
    """Write an image, complete or not at all; the extension decides the format.

    Args:
        path: the file: PNG or TIFF for uint8 and uint16, EXR or TIFF for float32, PNG for a CompressedImage.
        array: [H, W, C], C = 1, 3 or 4, straight alpha.
        metadata: stored as one JSON object in the image's description.
        compression: "fast" or "small".

    Raises:
        InputError: the image does not fit the format, or the file cannot be written.
    """
    path = check_image_path(path)
    suffix = path.suffix.lower()
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or 0 in array.shape or max(array.shape) > MAX_SIDE_PX:
        raise InputError(f"cannot write {path}: expected [H, W, 1, 3 or 4], got {list(array.shape)}")
    if array.dtype.name not in _DTYPES[suffix]:
        raise InputError(f"cannot write {path}: {suffix} takes {' or '.join(_DTYPES[suffix])}, got {array.dtype.name}")
    if isinstance(array, CompressedImage) and suffix != ".png":
        raise InputError(f"cannot write {path}: the image is compressed for PNG")
    if compression not in _SETTINGS:
        raise InputError(f"compression must be fast or small, got {compression!r}")
    texts = {}
    if metadata:
        texts = {_METADATA_KEY: json.dumps(metadata), "Software": metadata.get("software", "lightfield-gs")}
    with atomic_path(path) as temporary:
        if isinstance(array, CompressedImage) or suffix == ".png" and compression == "fast":
            write_png(temporary, array, {_PNG_KEYWORDS.get(key, key): text for key, text in texts.items()})
        else:
            _write_by_oiio(path, temporary, array, {**_SETTINGS[compression][suffix], **texts})


def _write_by_oiio(path: Path, temporary: Path, array: np.ndarray, attributes: dict[str, int | str]) -> None:
    """Write a checked image by OpenImageIO with these attributes; errors name `path`."""
    import OpenImageIO as oiio

    height, width, channels = array.shape
    if path.suffix.lower() == ".exr" and channels == 4:
        array = np.concatenate([array[..., :3] * array[..., 3:], array[..., 3:]], 2)  # its alpha is premultiplied
    spec = oiio.ImageSpec(width, height, channels, oiio.TypeDesc(_oiio_type(array.dtype)))
    for key, value in {**attributes, "oiio:UnassociatedAlpha": 1}.items():
        spec[key] = value
    output = oiio.ImageOutput.create(str(temporary))
    if output is None:
        raise InputError(f"cannot write {path}: {_first_line(oiio.geterror)}")
    written = output.open(str(temporary), spec) and output.write_image(np.ascontiguousarray(array))
    if not (output.close() and written):
        raise InputError(f"cannot write {path}: {_first_line(output.geterror)}")


def read_info(path: str | Path) -> ImageInfo:
    """Read the header of an image file; raise InputError as read_image does."""
    path = _checked_file(path)
    if is_heif(path):
        with open_heif(path, partial(_check_size, path)) as image:
            bands, turned = len(image.getbands()), heif_orientation(path, image)
            return ImageInfo(*image.size, bands, "uint8", orientation=turned, has_alpha=bands in (2, 4))
    with _opened(path) as source:
        spec = source.spec()
        return ImageInfo(
            spec.width,
            spec.height,
            spec.nchannels,
            str(spec.format),
            _metadata(spec.get_string_attribute(_METADATA_KEY)),
            spec.get_int_attribute("Orientation", 1),
            spec.nchannels in (2, 4) and (source.format_name() != "openexr" or spec.alpha_channel > 0),
        )


def read_image(path: str | Path, as_stored: bool = False, turn: bool = True) -> np.ndarray:
    """Read the first sub-image of an image file.

    Args:
        path: the file.
        as_stored: keep uint8, uint16 or float32; else integers are scaled to float32 in 0..1.
        turn: apply the Exif orientation. Cameras of posed views refer to pixels as stored.

    Returns:
        Pixels [H, W, C], straight alpha.

    Raises:
        InputError: the file is no image, damaged, cut, empty or absurdly large.
    """
    pixels = read_picture(path, turn).pixels
    return pixels if as_stored else as_floats(pixels)


def as_floats(pixels: np.ndarray) -> np.ndarray:
    """Scale uint8 and uint16 to float32 in 0..1; keep float32."""
    if pixels.dtype == np.float32:
        return pixels
    return pixels / np.float32(np.iinfo(pixels.dtype).max)  # OpenImageIO's own scaling is not exact


def read_picture(path: str | Path, turn: bool = True) -> Picture:
    """Read the first sub-image of an image file with its orientation and colour space; see read_image."""
    path = _checked_file(path)
    if is_heif(path):
        with open_heif(path, partial(_check_size, path)) as image:
            pixels, orientation, colour = decode_heif(path, image)
        return _picture(pixels, orientation, colour, turn)
    with _opened(path, pixels=True) as source:
        spec = source.spec()
        sample_type = {"uint8": "uint8", "uint16": "uint16"}.get(str(spec.format), "float")
        pixels = source.read_image(0, 0, 0, spec.nchannels, sample_type)
        if pixels is None or source.has_error:
            raise InputError(f"{path} is damaged or cut: {_first_line(source.geterror)}")
        orientation = spec.get_int_attribute("Orientation", 1)
        stored = {name: spec.getattribute(name) for name in _COLOUR_ATTRIBUTES}
        colour = {
            "format": source.format_name(),
            **{name: value for name, value in stored.items() if value is not None},
        }
        if colour["format"] == "png":
            colour |= png_colour(path)
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
    is_straight = colour["format"] not in _MAYBE_ASSOCIATED or "oiio:UnassociatedAlpha" in colour
    if spec.alpha_channel > 0 and not is_straight:
        pixels = _unpremultiply(pixels, spec.alpha_channel)
    return _picture(pixels, orientation, colour, turn)


@dataclass(frozen=True)
class Layer:
    """One channel of an EXR.

    Attributes:
        name: name with part and layers, separated by dots.
        pixels: float32 [H, W].
    """

    name: str
    pixels: np.ndarray


def read_layer(path: str | Path, choose: Callable[[Sequence[str]], int | None]) -> Layer | None:
    """Read one channel of an EXR.

    Args:
        path: the file.
        choose: takes the names of the channels of all parts, and returns the index of one, or None.

    Returns:
        The channel; None for other formats and without a choice.

    Raises:
        InputError: see read_image.
    """
    import OpenImageIO as oiio

    path = _checked_file(path)
    if is_heif(path):
        return None
    with _opened(path, most_channels=_MOST_LAYERS) as source:
        if source.format_name() != "openexr":
            return None
        found: list[tuple[int, int, str]] = []
        part = 0
        while source.seek_subimage(part, 0):
            spec = source.spec()
            layer = spec.get_string_attribute("oiio:subimagename") or spec.get_string_attribute("name")
            for index, name in enumerate(spec.channelnames):
                found.append((part, index, name if "." in name or not layer else f"{layer}.{name}"))
            part += 1
        oiio.geterror()  # clear the error of seeking past the last part
        chosen = choose([name for _, _, name in found])
        if chosen is None:
            return None
        part, index, name = found[chosen]
        source.seek_subimage(part, 0)
        spec = source.spec()
        _check_size(path, spec.width, spec.height, 1, 4)
        if spec.deep:
            raise InputError(f"{path}: expected one number a pixel, got a deep image; flatten it")
        pixels = source.read_image(part, 0, index, index + 1, "float")
        if pixels is None or source.has_error:
            raise InputError(f"{path} is damaged or cut: {_first_line(source.geterror)}")
        return Layer(name, np.asarray(pixels, np.float32).reshape(spec.height, spec.width))


def _picture(pixels: np.ndarray, orientation: int, colour: dict[str, Any], turn: bool) -> Picture:
    return Picture(
        np.ascontiguousarray(apply_orientation(pixels, orientation) if turn else pixels), orientation, colour
    )


def _unpremultiply(pixels: np.ndarray, channel: int) -> np.ndarray:
    """Convert premultiplied pixels [H, W, C] to straight alpha; channel: index of alpha, after the colours."""
    most = np.float32(1 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max)
    alpha = pixels[..., channel : channel + 1] / most
    with np.errstate(over="ignore"):
        colours = pixels[..., :channel] / np.where(alpha > 0, alpha, 1)
    if pixels.dtype != np.float32:
        colours = np.rint(np.minimum(colours, most))
    return np.concatenate([colours.astype(pixels.dtype), pixels[..., channel:]], 2)


def _checked_file(path: str | Path) -> Path:
    """Return the path of a readable, non-empty file; raise InputError for others."""
    path = checked_path(path)
    with reading(path):
        if path.is_dir():
            refuse_unsupported(path)
        if path.stat().st_size == 0 or not path.is_file():
            raise InputError(f"{path} is no image: it is empty or not a file")
        refuse_large_non_image(path)
    return path


@contextlib.contextmanager
def _opened(path: Path, pixels: bool = False, most_channels: int = _MOST_CHANNELS) -> Iterator:
    """Open an ImageInput, and check its size; pixels: its pixels will be read."""
    import OpenImageIO as oiio

    if damage := png_damage(path, pixels):
        raise InputError(f"{path} is damaged or cut: {damage}")
    _check_size(path, *_webp_size(path))  # OpenImageIO decodes a WebP when it opens it
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        reason = _first_line(oiio.geterror)  # fetched in any case: OpenImageIO prints errors that are left at exit
        refuse_video(path)
        refuse_non_image(path)
        raise InputError(f"{path} is not an image that can be read: {reason}")
    try:
        spec = source.spec()
        if spec.depth > 1 or not 1 <= spec.nchannels <= most_channels:
            raise InputError(
                f"{path}: expected a flat image of 1..{most_channels} channels, got {spec.nchannels} channels and "
                f"depth {spec.depth}"
            )
        _check_size(path, spec.width, spec.height, spec.nchannels, spec.format.size())
        yield source
    finally:
        source.close()


def _check_size(path: Path, width: int, height: int, channels: int = 4, sample_bytes: int = 1) -> None:
    """Raise InputError for an image that is too large, or too large for its file."""
    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX and width * height <= MAX_PIXELS):
        raise InputError(
            f"{path}: {width} x {height} pixels; expected 1..{MAX_SIDE_PX} a side and at most {MAX_PIXELS} in all"
        )
    size, samples = path.stat().st_size, width * height * channels
    if samples * sample_bytes > max(_SMALL_BYTES, _MOST_EXPANSION * size) or samples > 4 * MAX_PIXELS:
        raise InputError(
            f"{path}: {width} x {height} pixels of {channels} channels from a file of {size} bytes; it is "
            "damaged, or made to exhaust the memory"
        )


def _webp_size(path: Path) -> tuple[int, int]:
    """Read the size in the header of a WebP (RFC 9649, sections 2.5 to 2.7); return 1, 1 for other files."""
    with path.open("rb") as file:
        start = file.read(30)
    if start[:4] != b"RIFF" or start[8:12] != b"WEBP" or len(start) < 30:
        return 1, 1
    if start[12:16] == b"VP8X":
        return 1 + int.from_bytes(start[24:27], "little"), 1 + int.from_bytes(start[27:30], "little")
    if start[12:16] == b"VP8L":
        bits = int.from_bytes(start[21:25], "little")
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    return int.from_bytes(start[26:28], "little") & 0x3FFF or 1, int.from_bytes(start[28:30], "little") & 0x3FFF or 1


def apply_orientation(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Turn and mirror pixels [H, W, ...] upright by the Exif orientation 1..8."""
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _metadata(text: str) -> dict[str, str]:
    try:
        data = parse_json(text)
    except ValueError:
        return {}
    return {str(k): str(v) for k, v in data.items()} if isinstance(data, dict) else {}


def _oiio_type(dtype: np.dtype) -> str:
    return {"float32": "float"}.get(dtype.name, dtype.name)


def _first_line(get_error: Callable[[], str]) -> str:
    """Return the first line of an error of OpenImageIO, which may quote bytes that are no UTF-8."""
    try:
        text = get_error()
    except UnicodeDecodeError as error:
        text = error.object.decode(errors="replace")
    return next((line.strip()[:200] for line in text.splitlines() if line.strip()), "no reason given")
