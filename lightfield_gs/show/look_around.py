"""Views of a light field in one HTML file, which needs nothing else: they follow the mouse, a finger or a tilt."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path

import numpy as np

from lightfield_gs.io.atomic import atomic_path

_PAGE = Path(__file__).parent / "page" / "files" / "look_around.html"
_WEBP_QUALITY = 85


def write_look_around_page(path: str | Path, frames: list[np.ndarray], title: str) -> None:
    """Writes frames, the left-most camera's first, each uint8 [h, w, 3], as a page that shows one of them at a time.

    The frames are in the file as WebP. Raises InputError where it cannot be written.
    """
    page = _PAGE.read_text(encoding="utf-8")
    height, width = frames[0].shape[:2]
    words = {"title": title, "width": width, "height": height, "frames": [_data_url(frame) for frame in frames]}
    # Within a script a "<" of a title could end it
    page = page.replace("{/* views */}", json.dumps(words).replace("<", "\\u003c"))
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _data_url(frame: np.ndarray) -> str:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(frame).save(file, "WEBP", quality=_WEBP_QUALITY, method=2)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}"
