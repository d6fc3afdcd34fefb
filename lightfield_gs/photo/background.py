"""Choose the background of an object: light or dark, whichever the object's rim stands out from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lightfield_gs.io.images import as_floats

Rgb = tuple[float, float, float]
LIGHT: Rgb = (1.0, 1.0, 1.0)
DARK: Rgb = (0.12, 0.12, 0.12)


@dataclass(frozen=True)
class BackgroundConstants:
    """The rim of an object and its contrast. The contrast was chosen by eye on nine photos."""

    contrast: float = 0.2  # distance in Oklab up to which a pixel hardly stands out from a background
    rim: float = 0.02  # width of the rim, as a fraction of the object's longer side
    most_px: int = 512  # longer side of the object as it is measured
    opaque: float = 0.9  # alpha from which on a pixel has the object's own colour


_C = BackgroundConstants()
# sRGB's primaries to the cones, and the cones' cube roots to Oklab (Ottosson, "A perceptual color space for image
# processing", 2020)
_TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_TO_OKLAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def choose_background(rgba: np.ndarray) -> tuple[Rgb, dict[Rgb, float]] | None:
    """Choose the background that the least of an object's rim resembles.

    Args:
        rgba: [H, W, 4], straight alpha, uint8 or floats in 0..1, sRGB.

    Returns:
        The background, LIGHT where both are as good; and for each background the fraction of the rim that hardly stands
        out from it. None where the photo has no transparent or no opaque pixel.
    """
    colours = _rim(rgba)
    if colours is None:
        return None
    rim = _oklab(colours)
    alike = {
        background: float((np.linalg.norm(rim - _oklab(np.array(background)), axis=1) < _C.contrast).mean())
        for background in (LIGHT, DARK)
    }
    return min(alike, key=lambda background: alike[background]), alike


def _rim(rgba: np.ndarray) -> np.ndarray | None:
    """Return the colours [M, 3], 0..1, of the opaque pixels near the object's outline."""
    step = max(1, max(rgba.shape) // (4 * _C.most_px))
    rgba = rgba[::step, ::step]
    solid = rgba[..., 3] >= (0.5 if rgba.dtype.kind == "f" else 128)
    if not solid.any() or solid.all():
        return None
    (box,) = ndimage.find_objects(solid.view(np.uint8))
    step = max(1, math.ceil(max(part.stop - part.start for part in box) / _C.most_px))
    small = as_floats(rgba[box][::step, ::step])
    distance = ndimage.distance_transform_edt(np.pad(small[..., 3] >= 0.5, 1))[1:-1, 1:-1]
    near = (distance > 0) & (distance <= max(1.5, _C.rim * max(small.shape)))
    own = near & (small[..., 3] >= _C.opaque)
    colours = small[own if own.any() else near][:, :3]
    return colours if len(colours) else None


def _oklab(rgb: np.ndarray) -> np.ndarray:
    """Return the Oklab coordinates of sRGB colours [..., 3] in 0..1."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb.clip(0) + 0.055) / 1.055) ** 2.4)
    return np.cbrt(linear @ _TO_CONES.T) @ _TO_OKLAB.T
