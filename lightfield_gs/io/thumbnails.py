"""Small pictures of photos, quickly: not their colours to the last bit."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.io.pillow_images import is_heif, open_heif, pillow_errors

if TYPE_CHECKING:
    from PIL import Image

_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")


def thumbnail(path: Path, side_px: int) -> bytes:
    """Return a photo as a WebP of at most this width and height.

    Raises InputError for files that Pillow does not read.
    """
    from PIL import ImageOps

    with pillow_errors(f"{path} is not an image that can be read"), _opened(path) as image:
        image.draft("RGB", (2 * side_px, 2 * side_px))  # JPEGs are decoded at a fraction of their size
        small = ImageOps.exif_transpose(image)
        small = small.convert("RGBA" if "A" in small.getbands() or "transparency" in small.info else "RGB")
        small.thumbnail((side_px, side_px))
        written = io.BytesIO()
        small.save(written, "WEBP", quality=80)
    return written.getvalue()


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    from PIL import Image

    if is_heif(path):
        with open_heif(path, lambda width, height: None) as image:
            yield image
    else:
        with Image.open(path, formats=_FORMATS) as image:
            yield image
