"""AVIF and HEIC, which OpenImageIO's packages do not read, through Pillow and the optional package pi-heif."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.pillow_images import pillow_complaints

if TYPE_CHECKING:
    from PIL import Image

_AVIF_BRANDS = (b"avif", b"avis")
# ISO/IEC 23008-12, annex B, and MIAF; whatever begins with another brand is a film, or something else
_BRANDS = (*_AVIF_BRANDS, b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1", b"mif2")
_MOST_BYTES = 1 << 28
_BRAND_BYTES = 128  # of a file that are looked at: they hold a dozen brands and more
_PACKAGES = ("pi_heif", "pillow_heif")  # one reader; the former lacks the encoder, which is under the GPL
_ORIENTATION_TAG = 0x0112


def is_heif(path: Path) -> bool:
    """Whether a file begins as AVIF or HEIC do."""
    return _brands(path)[:1] in ([brand] for brand in _BRANDS)


def _brands(path: Path) -> list[bytes]:
    """The brand that the file says it has, and then those it is compatible with; empty where it is no such file."""
    with path.open("rb") as file:
        start = file.read(_BRAND_BYTES)
    if start[4:8] != b"ftyp" or len(start) < 12:
        return []
    start = start[: int.from_bytes(start[:4], "big")]
    return [start[8:12], *(start[at : at + 4] for at in range(16, len(start), 4))]


@contextlib.contextmanager
def opened_heif(path: Path, check_size: Callable[[int, int], None]) -> Iterator[Image.Image]:
    """The image, not decoded yet, once check_size(width, height) let it pass. Raises InputError."""
    from PIL import Image

    format_name = _reader(path)
    if (size := path.stat().st_size) > _MOST_BYTES:  # it is read as a whole
        raise InputError(f"{path}: expected an AVIF or HEIC of at most {_MOST_BYTES} bytes, got {size}; it is damaged")
    with pillow_complaints(f"{path} is not an image that can be read"):
        image = Image.open(path, formats=[format_name])
    with image:
        check_size(*image.size)
        yield image


def decoded_heif(path: Path, image: Image.Image) -> tuple[np.ndarray, int, dict[str, Any]]:
    """Pixels [H, W, C] uint8 as stored, Exif orientation and colour of an open image, as Picture has them."""
    with pillow_complaints(f"{path} is damaged or cut"):
        mode = image.mode if image.mode in ("L", "LA", "RGB", "RGBA") else "RGB"
        pixels = np.array(image.convert(mode))
    colour: dict[str, Any] = {"format": cast(str, image.format).lower()}  # none only of images that no file holds
    if profile := image.info.get("icc_profile"):
        colour["ICCProfile"] = profile
    elif kind := image.info.get("nclx_profile"):
        colour["CICP"] = kind["color_primaries"], kind["transfer_characteristics"]
    return pixels.reshape(*pixels.shape[:2], -1), heif_orientation(path, image), colour


def heif_orientation(path: Path, image: Image.Image) -> int:
    """The Exif orientation 1..8 of an open image: of its pixels as decoded_heif has them. Raises InputError."""
    with pillow_complaints(f"{path} is damaged or cut"):
        orientation = image.getexif().get(_ORIENTATION_TAG, 1)
    return orientation if isinstance(orientation, int) else 1


def _reader(path: Path) -> str:
    """The name of the format for Pillow, whose reader is there from now on. Raises InputError where there is none."""
    from PIL import features

    if set(_brands(path)) & set(_AVIF_BRANDS):
        if features.check("avif"):
            return "AVIF"
        raise InputError(
            f"{path} is an AVIF image, which the installed Pillow does not read: pip install -U "
            "'pillow>=11.3'; or convert it to PNG or JPEG"
        )
    for name in _PACKAGES:
        with contextlib.suppress(ImportError):
            importlib.import_module(name).register_heif_opener()
            return "HEIF"
    raise InputError(
        f"{path} is a HEIC image, which takes a package to read: pip install 'lightfield-gs[heif]'; or "
        "convert it to PNG or JPEG"
    )
