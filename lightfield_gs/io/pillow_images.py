"""What Pillow tells of image files: how many pictures they hold; and pictures that lie inside other files."""

from __future__ import annotations

import contextlib
import io
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lightfield_gs.base.errors import InputError

if TYPE_CHECKING:
    from PIL import Image

_STARTS = (b"GIF8", b"RIFF", b"\x89PNG", b"II*\0", b"MM\0*", b"\xff\xd8\xff")
_FORMATS = ("GIF", "WEBP", "PNG", "TIFF", "JPEG")  # the reader of JPEG finds out what is MPO
_MOST_PIXELS = 1 << 26  # of a picture inside another
_SECOND_EYES = ("Multi-Frame Image (Disparity)", "Multi-Frame Image (Multi-Angle)")
# What Pillow and its plugins raise of damaged files, beside its DecompressionBombError
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


def pictures_in(path: Path) -> tuple[int, bool]:
    """How many pictures of one size a file holds, in a row or a page each, and whether they are those of two eyes.

    Of an image without, and of a file that Pillow does not read, 1: what reads it says what is wrong.
    """
    with open(path, "rb") as file:
        if not file.read(4).startswith(_STARTS):
            return 1, False
    with contextlib.suppress(InputError), _opened(path, str(path)) as image:
        count = getattr(image, "n_frames", 1)
        if count < 2:
            return 1, False
        if image.format == "MPO":
            return (2, True) if _has_second_eye(path, image) else (1, False)
        size = image.size
        image.seek(1)
        return (count, False) if image.size == size else (1, False)
    return 1, False


def decoded(name: str, data: bytes) -> np.ndarray:
    """A PNG or JPEG in memory, uint8 or uint16 [H, W, C]; name: of what it is, for complaints. Raises InputError."""
    with _opened(io.BytesIO(data), name) as image:
        if image.width * image.height > _MOST_PIXELS:
            raise InputError(f"{name}: {image.width} x {image.height} pixels; expected at most {_MOST_PIXELS}")
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16)[..., None]
        pixels = np.asarray(image if image.mode in ("L", "RGB") else image.convert("RGB"))
        return pixels.reshape(*pixels.shape[:2], -1)


def _has_second_eye(path: Path, image: Image.Image) -> bool:
    """Whether the second picture of an MPO is another eye's, and no preview, gain map or depth map, as phones have."""
    entries = getattr(image, "mpinfo", {}).get(_MP_ENTRIES, ())
    kinds = [entry.get("Attribute", {}).get("MPType") for entry in entries]
    if any(kind in _SECOND_EYES for kind in kinds):
        return True
    size, mode = image.size, image.mode
    image.seek(1)
    return path.suffix.lower() == ".mpo" and image.size == size and image.mode == mode


@contextlib.contextmanager
def _opened(source: Path | io.BytesIO, name: str) -> Iterator[Image.Image]:
    """An open image, of whatever is wrong with it an InputError."""
    from PIL import Image

    with pillow_complaints(f"{name} is not an image that can be read"), Image.open(source, formats=_FORMATS) as image:
        yield image


@contextlib.contextmanager
def pillow_complaints(words: str) -> Iterator[None]:
    """Makes an InputError, with these words before, of all that Pillow raises of files that are damaged, and leaves out
    its warnings."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of size and of damaged metadata
            yield
    except InputError:
        raise
    except (*_RAISED, Image.DecompressionBombError) as error:
        raise InputError(f"{words}: {' '.join(str(error).split())[:200] or type(error).__name__}") from error
