"""PlayCanvas' SOG, versions 1 and 2, and gsplat's PngCompression: images whose pixels are Gaussians.

A SOG is a folder or a ZIP (.sog) of a meta.json and images. Centres have 16 bits on a scale of sign(x) log(1 + |x|).
Quaternions are wxyz by their three smallest components; alpha - 252 is the index of the missing one. Version 1 has
scales (logarithms), colours and logits between extremes, version 2 by codebooks of 256 numbers, and opacities
themselves. Harmonics above degree 0 are entries of a palette, 64 in a row. Specification: developer.playcanvas.com,
"The SOG Format". It calls y up, but files of splat-transform keep the axes of the original .ply, as this reader does.

gsplat's PngCompression writes PNG files of fixed names and a meta.json with extremes, mostly in the layout of SOG
version 1. Quaternions have four components, and harmonics above degree 0 are in a palette in shN.npz.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.checks import is_row, shown, whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.npy import stored_arrays
from lightfield_gs.io.scenes.comments import ANTIALIASED
from lightfield_gs.io.scenes.scene_arrays import SceneArrays, checked_fields, complete_quaternions, limit_degree
from lightfield_gs.io.scenes.sog_files import META, SogFiles

COEFFICIENTS = {1: 3, 2: 8, 3: 15, 4: 24}  # above degree 0, by degree
ROW_ENTRIES = 64  # of the palette
_MOST_ENTRIES = 1 << 16
_MOST_COUNT = (1 << 31) - 1  # Gaussians
LEAST_MODE = 252  # alpha of quaternions
_FARTHEST = 80.0  # log(1 + |x|); float32 ends there
_LOSSY_NOTE = "its images are lossy WebP, which a SOG should not have: values may be far off"
_Meta = dict[str, Any]


def read(path: Path, skip_invalid: bool) -> SceneArrays:
    """Read a folder, its meta.json or a ZIP, of SOG or of gsplat; see files.read_arrays."""
    with SogFiles(path) as files, named(path), np.errstate(over="ignore"):
        meta = files.meta()
        if _is_gsplat(meta):
            fields, left_out = _gsplat_fields(files, meta)
            fields, notes = checked_fields(path, fields, skip_invalid)
            return SceneArrays(fields, notes=notes + left_out, kind="gsplat's PNG compression")
        version = whole_number(f"{META}: version", meta.get("version", 1), 1, 2)
        count = whole_number(f"{META}: count", _count(meta), 1, _MOST_COUNT)
        means, quats, scales, sh0 = (_part(meta, name) for name in ("means", "quats", "scales", "sh0"))
        colours = files.image(_file(sh0, 0), count)[:count]
        fields = {
            "means": _decode_centres(files, means, count),
            "quaternions": _decode_rotations(files.image(_file(quats, 0), count)[:count]),
            "scales": np.exp(_decode(scales, files.image(_file(scales, 0), count)[:count, :3])),
            "opacities": colours[:, 3] / 255,
            "sh": _decode(sh0, colours[:, :3], 4)[:, None],
        }
        if "codebook" not in sh0:
            low, high = (_numbers(sh0, end, 4)[3] for end in ("mins", "maxs"))
            fields["opacities"] = 1 / (1 + np.exp(-(low + (high - low) * fields["opacities"])))
        notes_on_rest: list[str] = []
        if "shN" in meta:
            rest, notes_on_rest = limit_degree(_decode_harmonics(files, _part(meta, "shN"), count))
            fields["sh"] = np.concatenate([fields["sh"], rest], 1)
        is_zip, is_lossy = not path.is_dir() and path.name.lower() != META, files.is_lossy
    fields, notes = checked_fields(path, fields, skip_invalid)
    notes += notes_on_rest + ([_LOSSY_NOTE] if is_lossy else [])
    kind = f"SOG version {version}, {'a ZIP' if is_zip else 'a folder'}"
    return SceneArrays(fields, comments=_comments(meta), notes=notes, kind=kind)


def _comments(meta: _Meta) -> tuple[str, ...]:
    """Return the line on anti-aliasing, by the key model, which older files call antialias."""
    model = meta.get("model", meta.get("antialias"))
    return (ANTIALIASED,) if model is True or str(model).lower() == "antialiased" else ()


def _part(meta: _Meta, name: str) -> _Meta:
    if not isinstance(part := meta.get(name), dict):
        raise InputError(f"{META}: expected an object {name}, got {shown(part)}; this is no SOG")
    return part


def _count(meta: _Meta) -> Any:
    """Return the number of Gaussians; version 1 has it as the first number of a shape."""
    if "count" in meta:
        return meta["count"]
    shape = _part(meta, "means").get("shape")
    return shape[0] if isinstance(shape, list) and shape else shape


def _file(part: _Meta, index: int) -> Any:
    files = part.get("files")
    if not isinstance(files, list) or len(files) <= index:
        raise InputError(f"{META}: expected names of files, got {shown(files)}")
    return files[index]


def _numbers(part: _Meta, name: str, count: int) -> np.ndarray:
    """Return a list of `count` finite numbers, or one repeated; float64 [count]."""
    values = part.get(name)
    values = values if isinstance(values, list) else [values] * count
    if not is_row(values, count) or not all(type(value) in (int, float) and abs(value) < 1e30 for value in values):
        raise InputError(f"{META}: {name}: expected {count} finite numbers, got {shown(part.get(name))}")
    return np.array(values, np.float64)


def _decode(part: _Meta, stored: np.ndarray, channels: int = 3) -> np.ndarray:
    """Decode bytes [N, 3] by a codebook, or between the extremes of the channels."""
    if "codebook" in part:
        return _numbers(part, "codebook", 256)[stored]
    low, high = (_numbers(part, end, channels)[:3] for end in ("mins", "maxs"))
    return low + (high - low) * (stored / 255)


def _decode_centres(files: SogFiles, part: _Meta, count: int) -> np.ndarray:
    lower, upper = (files.image(_file(part, index), count)[:count, :3].astype(np.int64) for index in (0, 1))
    low, high = (_numbers(part, end, 3) for end in ("mins", "maxs"))
    if max(np.abs(low).max(), np.abs(high).max()) > _FARTHEST:
        raise InputError(f"{META}: means: expected logarithms of 1 + |x| within {_FARTHEST:g}; its extremes are wrong")
    logs = low + (high - low) * ((upper << 8 | lower) / 65535)
    return np.sign(logs) * np.expm1(np.abs(logs))


def _decode_rotations(stored: np.ndarray) -> np.ndarray:
    if (bad := stored[:, 3] < LEAST_MODE).any():
        index = int(bad.argmax())
        raise InputError(f"quats: expected alpha 252..255, got {stored[index, 3]} of Gaussian {index}; a wrong image")
    return complete_quaternions((stored[:, :3] / 255 - 0.5) * math.sqrt(2), stored[:, 3].astype(np.int64) - LEAST_MODE)


def _decode_harmonics(files: SogFiles, part: _Meta, count: int) -> np.ndarray:
    """Decode coefficients above degree 0, [N, K - 1, 3]."""
    labels = files.image(_file(part, 1), count)[:count].astype(np.int64)
    labels = labels[:, 0] | labels[:, 1] << 8
    entries = whole_number("shN: count", part.get("count", int(labels.max()) + 1), 1, _MOST_ENTRIES)
    if int(labels.max()) >= entries:
        raise InputError(f"shN: expected labels below {entries}, got {labels.max()}; a wrong image or count")
    bands = whole_number("shN: bands", part["bands"] if "bands" in part else _degree(part), 1, len(COEFFICIENTS))
    each, rows = COEFFICIENTS[bands], -(-entries // ROW_ENTRIES)
    width = ROW_ENTRIES * each
    palette = files.image(_file(part, 0), width * rows, width)[: width * rows, :3].reshape(-1, 3)
    return _decode(part, palette).reshape(-1, each, 3)[labels]


def _degree(part: _Meta) -> Any:
    """Return the degree in version 1, which has the number of coefficients in a shape."""
    shape = part.get("shape")
    sizes = {each: b for b, each in COEFFICIENTS.items()} | {3 * each: bands for bands, each in COEFFICIENTS.items()}
    return sizes.get(shape[-1]) if isinstance(shape, list) and shape and isinstance(shape[-1], int) else None


# gsplat's PngCompression


def _is_gsplat(meta: _Meta) -> bool:
    """Tell gsplat's meta.json from a SOG's."""
    return all(isinstance(meta.get(name), dict) and "files" not in meta[name] for name in ("means", "opacities"))


def _gsplat_fields(files: SogFiles, meta: _Meta) -> tuple[dict[str, np.ndarray], list[str]]:
    """Return the five fields, float64, and a note where harmonics of degree 4 were left out."""
    count = whole_number(f"{META}: means: shape", (_shape(meta, "means") or [0])[0], 1, _MOST_COUNT)
    lower, upper = (files.image(f"means_{end}.png", count)[:count, :3].astype(np.int64) for end in "lu")
    logs = _interpolate(meta, "means", (upper << 8 | lower) / 65535)
    if np.abs(logs).max() > _FARTHEST:
        raise InputError(f"{META}: means: expected logarithms of 1 + |x| within {_FARTHEST:g}; its extremes are wrong")
    logits = _interpolate(meta, "opacities", files.image("opacities.png", count)[:count, :1] / 255)[:, 0]
    colours = _interpolate(meta, "sh0", files.image("sh0.png", count)[:count, :3] / 255)
    rest, left_out = limit_degree(_gsplat_rest(files, meta, count) if "shN" in meta else np.zeros((count, 0, 3)))
    with np.errstate(over="ignore"):
        fields = {
            "means": np.sign(logs) * np.expm1(np.abs(logs)),
            "quaternions": _interpolate(meta, "quats", files.image("quats.png", count)[:count] / 255),
            "scales": np.exp(_interpolate(meta, "scales", files.image("scales.png", count)[:count, :3] / 255)),
            "opacities": 1 / (1 + np.exp(-logits)),
            "sh": np.concatenate([colours[:, None], rest], 1),
        }
    return fields, left_out


def _shape(meta: _Meta, name: str) -> list[Any]:
    shape = _part(meta, name).get("shape")
    return shape if isinstance(shape, list) else []


def _interpolate(meta: _Meta, name: str, fractions: np.ndarray) -> np.ndarray:
    """Interpolate by fractions [N, C] between the extremes of a part, given for each channel or once for all."""
    low, high = (_gsplat_numbers(meta, name, end, fractions.shape[1]) for end in ("mins", "maxs"))
    return low + (high - low) * fractions


def _gsplat_numbers(meta: _Meta, name: str, end: str, channels: int) -> np.ndarray:
    values: Any = _part(meta, name).get(end)
    while is_row(values, 1) and isinstance(values[0], list):
        values = values[0]
    values = values if isinstance(values, list) else [values]
    values = values * channels if len(values) == 1 else values
    if len(values) != channels or not all(type(value) in (int, float) and abs(value) < 1e30 for value in values):
        raise InputError(f"{META}: {name}: {end}: expected {channels} finite numbers, got {shown(values)}")
    return np.array(values, np.float64)


def _gsplat_rest(files: SogFiles, meta: _Meta, count: int) -> np.ndarray:
    """Return harmonics above degree 0, [N, K - 1, 3]."""
    each = (_shape(meta, "shN") + [0, 0])[1]
    if each not in (0, *COEFFICIENTS.values()):
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
    return _interpolate(meta, "shN", palette / ((1 << bits) - 1)).reshape(-1, each, 3)[labels]
