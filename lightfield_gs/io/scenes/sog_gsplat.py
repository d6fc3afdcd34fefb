"""What gsplat's PngCompression writes: PNG files of fixed names and a meta.json with the extremes of their numbers.

It has the layout of SOG's first version but for the quaternions, whose four components are stored, and the harmonics
above degree 0, an entry of a palette for each Gaussian, in shN.npz. Centres are stored as sign(x) log(1 + |x|), scales
as logarithms, opacities as logits.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lightfield_gs.base.checks import is_row, shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.npy import stored_arrays
from lightfield_gs.io.scenes.sog_files import META, SogFiles
from lightfield_gs.io.scenes.stored_scene import drawn_bands

_Meta = dict[str, Any]
_MOST = (1 << 31) - 1  # Gaussians
_COUNTS = (0, 3, 8, 15, 24)  # of coefficients above degree 0, by degree
KIND = "gsplat's PNG compression"


def is_compressed(meta: _Meta) -> bool:
    """Whether a meta.json is gsplat's, and no SOG's."""
    return all(isinstance(meta.get(name), dict) and "files" not in meta[name] for name in ("means", "opacities"))


def fields_of(files: SogFiles, meta: _Meta) -> tuple[dict[str, np.ndarray], list[str]]:
    """The five fields, float64, and a note where harmonics of degree 4 were left out. Raises InputError."""
    count = whole_number(f"{META}: means: shape", (_shape(meta, "means") or [0])[0], 1, _MOST)
    lower, upper = (files.image(f"means_{end}.png", count)[:count, :3].astype(np.int64) for end in "lu")
    logs = _between(meta, "means", (upper << 8 | lower) / 65535)
    if np.abs(logs).max() > 80:
        raise InputError(f"{META}: means: expected logarithms of 1 + |x| within 80; its extremes are wrong")
    logits = _between(meta, "opacities", files.image("opacities.png", count)[:count, :1] / 255)[:, 0]
    colours = _between(meta, "sh0", files.image("sh0.png", count)[:count, :3] / 255)
    rest, left_out = drawn_bands(_rest(files, meta, count) if "shN" in meta else np.zeros((count, 0, 3)))
    with np.errstate(over="ignore"):
        fields = {
            "means": np.sign(logs) * np.expm1(np.abs(logs)),
            "quaternions": _between(meta, "quats", files.image("quats.png", count)[:count] / 255),
            "scales": np.exp(_between(meta, "scales", files.image("scales.png", count)[:count, :3] / 255)),
            "opacities": 1 / (1 + np.exp(-logits)),
            "sh": np.concatenate([colours[:, None], rest], 1),
        }
    return fields, left_out


def _part(meta: _Meta, name: str) -> _Meta:
    if not isinstance(part := meta.get(name), dict):
        raise InputError(f"{META}: expected an object {name}, got {shown(part)}")
    return part


def _shape(meta: _Meta, name: str) -> list[Any]:
    shape = _part(meta, name).get("shape")
    return shape if isinstance(shape, list) else []


def _between(meta: _Meta, name: str, shares: np.ndarray) -> np.ndarray:
    """Values [N, C] at these shares of the way between the extremes of a part, a number for each channel or for all."""
    low, high = (_numbers(meta, name, end, shares.shape[1]) for end in ("mins", "maxs"))
    return low + (high - low) * shares


def _numbers(meta: _Meta, name: str, end: str, channels: int) -> np.ndarray:
    values: Any = _part(meta, name).get(end)
    while is_row(values, 1) and isinstance(values[0], list):
        values = values[0]
    values = values if isinstance(values, list) else [values]
    values = values * channels if len(values) == 1 else values
    if len(values) != channels or not all(type(value) in (int, float) and abs(value) < 1e30 for value in values):
        raise InputError(f"{META}: {name}: {end}: expected {channels} finite numbers, got {shown(values)}")
    return np.array(values, np.float64)


def _rest(files: SogFiles, meta: _Meta, count: int) -> np.ndarray:
    """Harmonics above degree 0, [N, K - 1, 3]."""
    each = (_shape(meta, "shN") + [0, 0])[1]
    if each not in _COUNTS:
        raise InputError(f"{META}: shN: expected a shape of {count} times 0, 3, 8, 15 or 24 times 3, got {shown(each)}")
    if each == 0:
        return np.zeros((count, 0, 3))
    bits = whole_number(f"{META}: shN: quantization", _part(meta, "shN").get("quantization", 8), 1, 16)
    if files.folder is None:
        raise InputError("its harmonics are in an archive inside the ZIP; unpack it, and give the folder")
    arrays = stored_arrays(files.folder / "shN.npz")
    if not {"centroids", "labels"} <= set(arrays):
        raise InputError(f"shN.npz: expected arrays centroids and labels, got {', '.join(arrays)[:80] or 'none'}")
    palette, labels = arrays["centroids"].read(), arrays["labels"].read().astype(np.int64)
    fits = palette.ndim == 2 and palette.shape[1] == 3 * each and labels.shape == (count,)
    if not fits or not 0 <= labels.min() <= labels.max() < len(palette):
        raise InputError(
            f"shN.npz: expected {count} labels of a palette of {3 * each} numbers, got {list(labels.shape)} and "
            f"{list(palette.shape)}"
        )
    return _between(meta, "shN", palette / ((1 << bits) - 1)).reshape(-1, each, 3)[labels]
