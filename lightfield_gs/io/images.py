"""Images in and out, through OpenImageIO: PNG (8 and 16 bit), EXR and TIFF out; whatever it knows, AVIF and HEIC in."""

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
from lightfield_gs.base.paths import checked_path
from lightfield_gs.io.atomic import atomic_path, check_output_path
from lightfield_gs.io.file_kinds import refuse_large_no_image, refuse_no_picture, refuse_unread, refuse_video
from lightfield_gs.io.pillow_images import decode_heif, heif_orientation, is_heif, open_heif
from lightfield_gs.io.png import CompressedImage, png_colour, png_damage, write_png
from lightfield_gs.io.text_files import parse_json

MAX_SIDE_PX = 65536
MAX_PIXELS = 1 << 28  # nine 8K frames: more is a mistake or an attack
_MOST_CHANNELS, _MOST_LAYERS = 16, 1024  # of a picture, and of an EXR of which one is read
# A file may become so many times as long in memory, or this many bytes: deflate reaches 1030 on a plain picture.
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
_MAYBE_ASSOCIATED = ("tiff", "openexr")  # alpha may be premultiplied in these; in all other formats it is straight
_METADATA_KEY = "ImageDescription"  # the one text field that PNG, EXR and TIFF all keep
_PNG_KEYWORDS = {_METADATA_KEY: "Description"}  # what OpenImageIO calls otherwise
_DTYPES = {
    ".png": ("uint8", "uint16"),
    ".exr": ("float32",),
    ".tif": ("uint8", "uint16", "float32"),
    ".tiff": ("uint8", "uint16", "float32"),
}
# Why PNG is written so: neighbours in a row belong to different views, so that nothing repeats but plain areas, which
# are runs, while the pixel above is often of the same view: all that "fast" looks for (io/png_file.py). Ordinary
# pictures become smaller where every row has the filter that suits it ("small").
# Measured on 8K frames of a photo's object and of a whole photo, on one core. PNG not compressed: 0.2 s, 89 MB; the
# filter Up and runs by zlib at level 1: 0.6 and 1.0 s, 12 and 31 MB, as "fast" does in a third of it by ISA-L;
# without a filter and with the usual search for repetitions: 0.6 and 1.4 s, 16 and 38 MB at level 1, 1.2 and 2.2 s, 15
# and 37 MB at level 6. EXR not compressed: 0.5 s, zip 1.7 s. TIFF not compressed: 0.1 s, zip 7 s.
_PNG_FILTER_ANY = 0xF8
_SETTINGS: dict[Compression, dict[str, dict[str, int | str]]] = {
    "fast": {
        ".png": {},  # by io/png_file.py
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
    """Header of an image file: size in pixels as stored, sample type as OpenImageIO names it, metadata of this package,
    the Exif orientation 1..8, and whether the last of 2 or 4 channels is alpha: in EXR it may be depth."""

    width_px: int
    height_px: int
    channels: int
    sample_type: str
    metadata: dict[str, str] = field(default_factory=dict)
    orientation: int = 1
    has_alpha: bool = False


@dataclass(frozen=True)
class Picture:
    """What an image file holds.

    pixels: [H, W, C] upright if so wanted, alpha straight; uint8, uint16 or float32 as in the file. orientation: the
    Exif orientation 1..8 of the file. colour: what the file says of its colours, by OpenImageIO's names, such as
    "ICCProfile" (bytes) and "oiio:ColorSpace"; "format" is the file's.
    """

    pixels: np.ndarray
    orientation: int = 1
    colour: dict[str, Any] = field(default_factory=dict)


def check_image_path(path: str | Path) -> Path:
    """`path`, if an image can be written there; raises InputError before any long work is done for nothing."""
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
    """Writes [H, W, C], C = 1, 3 or 4, complete or not at all.

    uint8 or uint16 as PNG or TIFF, float32 as EXR or TIFF; the extension decides; what is compressed already as
    PNG. `metadata` is kept as one JSON object in the image's description. compression: "fast" or
    "small". Alpha is straight, not premultiplied.
    Raises InputError.
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
    """Writes what write_image has checked, for `path`, with these attributes of OpenImageIO. Raises InputError."""
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
    """Header of an image file. Raises InputError as read_image does."""
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
    """Pixels [H, W, C] of an image file (its first sub-image), alpha straight.

    float32, integers scaled to 0..1; or with `as_stored` uint8, uint16 or float32 as in the file.
    turn: upright, as the Exif orientation says; else as the file has them, which the cameras of posed views refer to.
    Raises InputError when it is no image, damaged, cut, empty or absurdly large.
    """
    pixels = read_picture(path, turn).pixels
    return pixels if as_stored else as_floats(pixels)


def as_floats(pixels: np.ndarray) -> np.ndarray:
    """uint8 and uint16 as float32 in 0..1; float32 as it is."""
    if pixels.dtype == np.float32:
        return pixels
    return pixels / np.float32(np.iinfo(pixels.dtype).max)  # OpenImageIO's own scaling is not exact


def read_picture(path: str | Path, turn: bool = True) -> Picture:
    """An image file (its first sub-image) with what it says of its orientation and colours. Raises InputError as
    read_image does. turn: see read_image."""
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
        said = {name: spec.getattribute(name) for name in _COLOUR_ATTRIBUTES}
        colour = {"format": source.format_name(), **{name: value for name, value in said.items() if value is not None}}
        if colour["format"] == "png":
            colour |= png_colour(path)
    pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
    straight = colour["format"] not in _MAYBE_ASSOCIATED or "oiio:UnassociatedAlpha" in colour
    if spec.alpha_channel > 0 and not straight:
        pixels = _straight(pixels, spec.alpha_channel)
    return _picture(pixels, orientation, colour, turn)


@dataclass(frozen=True)
class Layer:
    """One channel of an EXR: its name with those of its layers and its part, and its pixels, float32 [H, W]."""

    name: str
    pixels: np.ndarray


def read_layer(path: str | Path, choose: Callable[[Sequence[str]], int | None]) -> Layer | None:
    """The channel of an EXR that is chosen of the names of all, in all its parts; None of other files and where none
    is chosen. Raises InputError as read_image does."""
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
        oiio.geterror()  # of looking for a part behind the last
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


def _straight(pixels: np.ndarray, channel: int) -> np.ndarray:
    """Pixels [H, W, C] with straight alpha, from premultiplied ones; channel: of alpha, after those of colours."""
    most = np.float32(1 if pixels.dtype == np.float32 else np.iinfo(pixels.dtype).max)
    share = pixels[..., channel : channel + 1] / most
    with np.errstate(over="ignore"):
        colours = pixels[..., :channel] / np.where(share > 0, share, 1)
    if pixels.dtype != np.float32:
        colours = np.rint(np.minimum(colours, most))
    return np.concatenate([colours.astype(pixels.dtype), pixels[..., channel:]], 2)


def _checked_file(path: str | Path) -> Path:
    """The path of a file that is there, can be read and is not empty; raises InputError."""
    path = checked_path(path)
    with reading(path):
        if path.is_dir():
            refuse_unread(path)
        if path.stat().st_size == 0 or not path.is_file():
            raise InputError(f"{path} is no image: it is empty or not a file")
        refuse_large_no_image(path)
    return path


@contextlib.contextmanager
def _opened(path: Path, pixels: bool = False, most_channels: int = _MOST_CHANNELS) -> Iterator:
    """An open ImageInput whose size has been checked; pixels: they are to be read."""
    import OpenImageIO as oiio

    if damage := png_damage(path, pixels):
        raise InputError(f"{path} is damaged or cut: {damage}")
    _check_size(path, *_webp_size(path))  # OpenImageIO decodes a WebP when it opens it
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        reason = _first_line(oiio.geterror)  # taken away, for OpenImageIO prints what is left of these at the end
        refuse_video(path)
        refuse_no_picture(path)
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
    """Raises InputError on an image that is too large, or too large for so small a file."""
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
    """Width and height that the header of a WebP states (RFC 9649, sections 2.5 to 2.7); 1, 1 of any other file."""
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
    """Undoes the rotation and mirroring of the Exif orientation 1..8, of pixels [H, W, ...]."""
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


def _first_line(complaint: Callable[[], str]) -> str:
    """The first line of what OpenImageIO complains of, which may quote bytes of a file that are no UTF-8."""
    try:
        text = complaint()
    except UnicodeDecodeError as error:
        text = error.object.decode(errors="replace")
    return next((line.strip()[:200] for line in text.splitlines() if line.strip()), "no reason given")
