"""Exif of photographs: the lens, and the time at which they were taken."""

from __future__ import annotations

import contextlib
import warnings
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.pillow_images import is_heif, open_heif

ORIENTATION = 0x0112
_EXIF = 0x8769
_MAKE_MODEL = (0x010F, 0x0110)
_FOCAL_MM, _FOCAL_35_MM, _LENS_MODEL = 0x920A, 0xA405, 0xA434
_TAKEN, _FRACTION = 0x9003, 0x9291  # DateTimeOriginal and SubSecTimeOriginal
_DIGITS = 3  # of a focal length in mm: further digits of one phone differ
LensKey = tuple[str, str, str, float, float]


def read_exif(path: Path) -> Any:
    """Return Pillow's Exif of a photograph, also of a HEIC; empty where Pillow finds none."""
    from PIL import Image

    errors = OSError, ValueError, SyntaxError, RuntimeError, EOFError, InputError
    with warnings.catch_warnings(), contextlib.suppress(*errors):
        warnings.simplefilter("ignore")  # of large pictures, which are not decoded here, and of damaged Exif
        with open_heif(path, lambda width, height: None) if is_heif(path) else Image.open(path) as image:
            exif = image.getexif()
            exif.get_ifd(_EXIF)
            return exif
    return Image.Exif()


def lens_key(path: Path) -> LensKey:
    """Return make, model, lens, focal length in mm and on 35 mm film, as far as the Exif has them; else "" and 0."""
    exif = read_exif(path)
    inner = exif.get_ifd(_EXIF)
    make, model = (_words(exif.get(tag)) for tag in _MAKE_MODEL)
    lens = _words(inner.get(_LENS_MODEL))
    return make, model, lens, _millimetres(inner.get(_FOCAL_MM)), _millimetres(inner.get(_FOCAL_35_MM))


def time_taken(path: Path) -> float | None:
    """Return when a photograph was taken, in seconds from an origin that all share; None where its Exif has no time."""
    inner = read_exif(path).get_ifd(_EXIF)
    try:
        seconds = datetime.strptime(_words(inner.get(_TAKEN)), "%Y:%m:%d %H:%M:%S").timestamp()
    except (ValueError, OverflowError, OSError):
        return None
    digits = _words(inner.get(_FRACTION))
    return seconds + (float(f"0.{digits}") if digits.isascii() and digits.isdigit() else 0.0)


def _words(value: Any) -> str:
    return "" if value is None else str(value).strip("\0 ")


def _millimetres(value: Any) -> float:
    """Return a focal length rounded to _DIGITS digits; 0 where there is none."""
    with contextlib.suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
        number = float(value)
        return float(f"{number:.{_DIGITS}g}") if 0 < number < np.inf else 0.0
    return 0.0
