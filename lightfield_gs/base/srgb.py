"""Light and its codes in sRGB (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np


def srgb_of_light(light: np.ndarray) -> np.ndarray:
    """sRGB code 0..1 of linear light 0..1 (IEC 61966-2-1)."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def light_of_srgb(code: np.ndarray) -> np.ndarray:
    """Linear light 0..1 of an sRGB code 0..1 (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((np.maximum(code, 0) + 0.055) / 1.055) ** 2.4)
