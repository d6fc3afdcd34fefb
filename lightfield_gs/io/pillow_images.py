"""Images through Pillow: several pictures in one file, pictures in memory, and AVIF and HEIC.

OpenImageIO's packages read neither AVIF nor HEIC. The package pi-heif reads HEIC; it lacks the encoder of pillow-heif,
which is under the GPL.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lightfield_gs.base.errors import InputError

if TYPE_CHECKING:
    from PIL import Image

_STARTS = (b"GIF8", b"RIFF", b"\x89PNG", b"II*\0", b"MM\0*", b"\xff\xd8\xff")
_FORMATS = ("GIF", "WEBP", "PNG", "TIFF", "JPEG")  # the reader of JPEG recognizes MPO
_MOST_PIXELS = 1 << 26  # of a picture in memory
_SECOND_EYES = ("(Disparity)", "(Multi-Angle)")  # ends of Pillow's names, whose beginnings differ between versions
# Errors that Pillow and its plugins raise for damaged files, beside its DecompressionBombError
_RAISED = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    EOFError,
    MemoryError,
    struct.error,
)
_MP_ENTRIES = 0xB002  # of the MP Index IFD (CIPA DC-007, Multi-Picture Format)
_AVIF_BRANDS = (b"avif", b"avis")
# ISO/IEC 23008-12, annex B, and MIAF; files of other brands are films or something else
_BRANDS = (*_AVIF_BRANDS, b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"mif2")
_MOST_BYTES = 1 << 28
_META_BYTES = 1 << 16  # where the properties of a HEIC stand
_BRAND_BYTES = 128  # read for the brands: they hold a dozen and more
_ORIENTATION_TAG = 0x0112
_JPEG_START = b"\xff\xd8\xff"
_BETWEEN_JPEGS = re.compile(rb"(?<=\xff\xd9)\x00*" + _JPEG_START)


@contextlib.contextmanager
def pillow_errors(words: str) -> Iterator[None]:
    """Turn all errors of Pillow for damaged files into InputErrors that begin with `words`; hide its warnings."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of size and of damaged metadata
            yield
    except InputError:
        raise
    except (*_RAISED, Image.DecompressionBombError) as error:
        raise InputError(f"{words}: {' '.join(str(error).split())[:200] or type(error).__name__}") from error


@contextlib.contextmanager
def _open(source: Path | io.BytesIO, name: str) -> Iterator[Image.Image]:
    """Open an image; raise InputError for whatever is wrong with it."""
    from PIL import Image

    with pillow_errors(f"{name} is not an image that can be read"), Image.open(source, formats=_FORMATS) as image:
        yield image


def count_pictures(path: Path) -> tuple[int, bool]:
    """Count the pictures of one size in a file: frames or pages.

    Returns:
        The count, and whether they are two eyes' pictures of a stereo file. 1 and False for files that Pillow does not
        read: their reader reports the error.
    """
    with open(path, "rb") as file:
        if not file.read(4).startswith(_STARTS):
            return 1, False
    if second_eye_number(path) is not None:
        return 2, True
    with contextlib.suppress(InputError), _open(path, str(path)) as image:
        count = getattr(image, "n_frames", 1)
        if count < 2 or image.format == "MPO":
            return 1, False
        size = image.size
        image.seek(1)
        return (count, False) if image.size == size else (1, False)
    return 1, False


def second_eye_number(path: Path) -> int | None:
    """Return the number, from 0, of the other eye's picture among those of a JPEG; None where there is none.

    Others are previews, gain maps or depth maps of phones. An .mpo may have lost its list of pictures.
    """
    with contextlib.suppress(InputError), _open(path, str(path)) as image:
        if image.format not in ("MPO", "JPEG"):
            return None
        entries = getattr(image, "mpinfo", {}).get(_MP_ENTRIES, ())
        kinds = [str(entry.get("Attribute", {}).get("MPType")) for entry in entries]
        if eyes := [number for number, kind in enumerate(kinds) if number and kind.endswith(_SECOND_EYES)]:
            return eyes[0]
        if path.suffix.lower() != ".mpo":
            return None
        size, mode = image.size, image.mode
        for number in range(1, max(len(kinds), len(_jpegs_in(path)))):
            with contextlib.suppress(InputError, *_RAISED), _open(_further(path, number), str(path)) as other:
                if other.size == size and other.mode == mode:
                    return number
    return None


def _jpegs_in(path: Path) -> list[bytes]:
    """Return the pictures of a file of JPEGs one after the other, by their markers."""
    return [_JPEG_START + part for part in _BETWEEN_JPEGS.split(path.read_bytes()[len(_JPEG_START) :])]


def _further(path: Path, number: int) -> io.BytesIO:
    """Return picture `number` of an MPO as a file of its own: by the list of pictures, or else by its markers."""
    from PIL import Image

    with contextlib.suppress(InputError), pillow_errors(str(path)):
        with Image.open(path, formats=_FORMATS) as image, path.open("rb") as file:
            image.seek(number)
            file.seek(getattr(image, "offset", 0))
            return io.BytesIO(file.read())
    parts = _jpegs_in(path)
    if number >= len(parts):
        raise InputError(f"{path}: its picture {number + 1} is missing; give stereo_in=none to take the first alone")
    return io.BytesIO(parts[number])


def decode_picture(name: str, data: bytes) -> np.ndarray:
    """Decode a PNG or JPEG in memory, uint8 or uint16 [H, W, C]; raise InputError, which begins with `name`."""
    with _open(io.BytesIO(data), name) as image:
        if image.width * image.height > _MOST_PIXELS:
            raise InputError(f"{name}: {image.width} x {image.height} pixels; expected at most {_MOST_PIXELS}")
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16)[..., None]
        pixels = np.asarray(image if image.mode in ("L", "RGB") else image.convert("RGB"))
        return pixels.reshape(*pixels.shape[:2], -1)


# AVIF and HEIC


def is_heif(path: Path) -> bool:
    """Tell whether a file begins as AVIF and HEIC do."""
    return _brands(path)[:1] in ([brand] for brand in _BRANDS)


def _brands(path: Path) -> list[bytes]:
    """Return a file's major brand, then its compatible brands; [] for files without."""
    with path.open("rb") as file:
        start = file.read(_BRAND_BYTES)
    if start[4:8] != b"ftyp" or len(start) < 12:
        return []
    start = start[: int.from_bytes(start[:4], "big")]
    return [start[8:12], *(start[at : at + 4] for at in range(16, len(start), 4))]


@contextlib.contextmanager
def open_heif(path: Path, check_size: Callable[[int, int], None]) -> Iterator[Image.Image]:
    """Open an image without decoding it; `check_size(width, height)` may raise InputError for its size."""
    from PIL import Image

    format_name = _register_reader(path)
    if (size := path.stat().st_size) > _MOST_BYTES:  # it is read as a whole
        raise InputError(f"{path}: expected an AVIF or HEIC of at most {_MOST_BYTES} bytes, got {size}; it is damaged")
    with pillow_errors(f"{path} is not an image that can be read"):
        image = Image.open(path, formats=[format_name])
    with image:
        check_size(*image.size)
        yield image


def decode_heif(path: Path, image: Image.Image) -> tuple[np.ndarray, int, dict[str, Any]]:
    """Decode an open image: pixels [H, W, C] uint8 as stored, Exif orientation, and colour as in images.Picture."""
    with pillow_errors(f"{path} is damaged or cut"):
        mode = image.mode if image.mode in ("L", "LA", "RGB", "RGBA") else "RGB"
        pixels = np.array(image.convert(mode))
    colour: dict[str, Any] = {"format": cast(str, image.format).lower()}  # None only for images that no file holds
    if profile := image.info.get("icc_profile"):
        colour["ICCProfile"] = profile
    elif kind := image.info.get("nclx_profile"):
        colour["CICP"] = kind["color_primaries"], kind["transfer_characteristics"]
    return pixels.reshape(*pixels.shape[:2], -1), heif_orientation(path, image), colour


def heif_orientation(path: Path, image: Image.Image) -> int:
    """Return the Exif orientation 1..8 of the pixels of decode_heif; raise InputError for damaged files."""
    with pillow_errors(f"{path} is damaged or cut"):
        orientation = image.getexif().get(_ORIENTATION_TAG, 1)
    return orientation if isinstance(orientation, int) else 1


def _register_reader(path: Path) -> str:
    """Register the reader of a file, and return the name of its format for Pillow; raise InputError without one."""
    from PIL import features

    if set(_brands(path)) & set(_AVIF_BRANDS):
        if features.check("avif"):
            return "AVIF"
        raise InputError(
            f"{path} is an AVIF image, which the installed Pillow does not read: pip install -U "
            "'pillow>=11.3'; or convert it to PNG or JPEG"
        )
    try:
        import pi_heif
    except ImportError as error:
        raise InputError(
            f"{path} is a HEIC image, and the package that reads it could not be imported ({error}): pip install "
            "--force-reinstall pi-heif; or convert it to PNG or JPEG"
        ) from None
    pi_heif.register_heif_opener()
    return "HEIF"


@dataclass(frozen=True)
class HeifDepth:
    """The depth map beside the picture of a HEIC (ISO/IEC 23008-12).

    Attributes:
        pixels: [H, W, C].
        orientation: The Exif orientation of the pixels: 1 where they are as upright as the picture.
        facts: Of its depth representation information (ITU-T H.265, F.14.2.3): `representation_type`, and of `z_near`,
            `z_far`, `d_min` and `d_max` those that the file states.
    """

    pixels: np.ndarray
    orientation: int
    facts: dict[str, float]


def read_heif_depth(path: Path) -> HeifDepth | None:
    """Return the depth map in a HEIC; None without one, as in every AVIF. Raises InputError."""
    with (
        open_heif(path, lambda width, height: None) as image,
        pillow_errors(f"{path}: the depth map inside it is damaged"),
    ):
        for depth in image.info.get("depth_images", ()):
            if not 0 < depth.size[0] * depth.size[1] <= _MOST_PIXELS:
                continue
            pixels = np.array(depth.to_pillow())
            # Both are turned alike (ISO/IEC 23000-22, 7.3.5); where only the photo is, Exif says how
            is_stored = (pixels.shape[0] > pixels.shape[1]) != (image.height > image.width)
            stored = image.info.get("original_orientation") or 1
            return HeifDepth(
                pixels.reshape(*pixels.shape[:2], -1),
                stored if is_stored and stored >= 5 else 1,
                dict(depth.info["metadata"]),
            )
    return None


# Further pictures


def read_further_picture(path: Path, number: int) -> np.ndarray:
    """Return picture `number` of an MPO or a HEIC, uint8 [H, W, C], as stored; of a HEIC upright; raise InputError."""
    with contextlib.ExitStack() as stack:
        if is_heif(path):
            image = stack.enter_context(open_heif(path, lambda width, height: None))
        else:
            image = stack.enter_context(_open(_further(path, number), f"{path}: its picture {number + 1}"))
        alone = f"{path}: its picture {number + 1} is damaged (stereo_in=none takes the first alone)"
        stack.enter_context(pillow_errors(alone))
        if is_heif(path):
            image.seek(number)
        if image.width * image.height > _MOST_PIXELS:
            raise InputError(f"{path}: {image.width} x {image.height} pixels; expected at most {_MOST_PIXELS}")
        return np.array(image.convert("RGB"))


@dataclass(frozen=True)
class HeifPairCameras:
    """The cameras of a stereo pair in a HEIC (ISO/IEC 23008-12).

    Attributes:
        focal: Focal length by the width of the picture; None: not stated.
        centre: Principal point by width and height.
        baseline_m: Distance between the cameras, metres; None: not stated.
    """

    focal: float | None
    centre: tuple[float, float]
    baseline_m: float | None


def heif_pair_cameras(path: Path) -> HeifPairCameras | None:
    """Return the cameras of the two pictures of a HEIC, None for those without a group of two eyes ('ster')."""
    with path.open("rb") as file:
        start = file.read(_META_BYTES)
    group = start.find(b"ster")
    if group < 0 or b"grpl" not in start[:group] or start[group + 12 : group + 16] != b"\0\0\0\2":
        return None
    focal, centre, places = None, (0.5, 0.5), []
    for at in _boxes(start, b"cmin"):
        flags = int.from_bytes(start[at + 1 : at + 4], "big")
        unit = 1 << ((flags & 0x1F00) >> 8)
        values = [value / unit for value in struct.unpack_from(">3i", start, at + 4)]
        focal, centre = (values[0], (values[1], values[2])) if focal is None else (focal, centre)
    for at in _boxes(start, b"cmex"):
        flags = start[at + 3]
        places.append(struct.unpack_from(">i", start, at + 4)[0] if flags & 1 else 0)
    apart = max(places, default=0) - min(places, default=0)
    return HeifPairCameras(focal, centre, apart * 1e-6 if apart else None)


def _boxes(data: bytes, name: bytes) -> Iterator[int]:
    """Yield where the contents of boxes of this type begin, whose numbers fit."""
    at = data.find(name)
    while at >= 0:
        if 16 <= int.from_bytes(data[at - 4 : at], "big") <= 64 and len(data) >= at + 24:
            yield at + 4
        at = data.find(name, at + 4)
