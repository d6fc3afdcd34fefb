"""What a PNG says of its colours that OpenImageIO keeps to itself."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any


def png_colour(path: Path) -> dict[str, Any]:
    """By OpenImageIO's names: "ICCProfile", also where it is broken, and "chromaticities", x and y of red, green, blue
    and white. Empty where the file is damaged."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # nothing is decoded
            with Image.open(path, formats=["PNG"]) as image:
                info = image.info
    except (OSError, ValueError, SyntaxError, MemoryError, Image.DecompressionBombError):
        return {}
    colour: dict[str, Any] = {}
    if info.get("icc_profile"):
        colour["ICCProfile"] = info["icc_profile"]
    elif "chromaticity" in info and "srgb" not in info:
        white, rest = info["chromaticity"][:2], info["chromaticity"][2:]
        colour["chromaticities"] = (*rest, *white)
    return colour
