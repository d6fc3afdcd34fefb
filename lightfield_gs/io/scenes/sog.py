"""PlayCanvas' SOG, versions 1 and 2: a meta.json and images whose pixels are Gaussians, in a folder or a ZIP (.sog).

Centres have 16 bits on a scale of sign(x) log(1 + |x|); quaternions are wxyz by their three smallest components, and
alpha - 252 says which is missing. Version 1 has scales (logarithms), colours and logits between extremes, version 2 by
codebooks of 256 numbers, and opacities themselves. Harmonics above degree 0 are entries of a palette, 64 in a row.
Specification: developer.playcanvas.com, "The SOG Format". It calls y up; the files that splat-transform writes keep the
axes of the .ply they were made of, which are those given here.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.checks import is_row, shown, whole_number
from lightfield_gs.base.errors import InputError, named
from lightfield_gs.io.scenes import render_mode, sog_gsplat
from lightfield_gs.io.scenes.sog_files import META, SogFiles
from lightfield_gs.io.scenes.stored_scene import StoredScene, completed, drawn_bands, settled

_COEFFICIENTS = {1: 3, 2: 8, 3: 15, 4: 24}  # above degree 0, by bands
_IN_A_ROW = 64  # entries of the palette
_MOST_ENTRIES = 1 << 16
_MOST = (1 << 31) - 1  # Gaussians
_LEAST_MODE = 252
_FARTHEST = 80.0  # of log(1 + |x|), beyond which float32 ends
_LOSSY_NOTE = "its images are lossy WebP, which a SOG should not have: values may be far off"
_Meta = dict[str, Any]


def read(path: Path, skip_invalid: bool) -> StoredScene:
    """See stored.py. path: a folder, its meta.json or a ZIP. Raises InputError."""
    with SogFiles(path) as files, named(path), np.errstate(over="ignore"):
        meta = files.meta()
        if sog_gsplat.is_compressed(meta):
            fields, left_out = sog_gsplat.fields_of(files, meta)
            fields, notes = settled(path, fields, skip_invalid)
            return StoredScene(fields, notes=notes + left_out, kind=sog_gsplat.KIND)
        version = whole_number(f"{META}: version", meta.get("version", 1), 1, 2)
        count = whole_number(f"{META}: count", _count(meta), 1, _MOST)
        means, quats, scales, sh0 = (_part(meta, name) for name in ("means", "quats", "scales", "sh0"))
        colours = files.image(_file(sh0, 0), count)[:count]
        fields = {
            "means": _centres(files, means, count),
            "quaternions": _rotations(files.image(_file(quats, 0), count)[:count]),
            "scales": np.exp(_values(scales, files.image(_file(scales, 0), count)[:count, :3])),
            "opacities": colours[:, 3] / 255,
            "sh": _values(sh0, colours[:, :3], 4)[:, None],
        }
        if "codebook" not in sh0:
            low, high = (_numbers(sh0, end, 4)[3] for end in ("mins", "maxs"))
            fields["opacities"] = 1 / (1 + np.exp(-(low + (high - low) * fields["opacities"])))
        notes_on_rest: list[str] = []
        if "shN" in meta:
            rest, notes_on_rest = drawn_bands(_harmonics(files, _part(meta, "shN"), count))
            fields["sh"] = np.concatenate([fields["sh"], rest], 1)
        is_zip, is_lossy = not path.is_dir() and path.name.lower() != META, files.is_lossy
    fields, notes = settled(path, fields, skip_invalid)
    notes += notes_on_rest + ([_LOSSY_NOTE] if is_lossy else [])
    kind = f"SOG version {version}, {'a ZIP' if is_zip else 'a folder'}"
    return StoredScene(fields, comments=_comments(meta), notes=notes, kind=kind)


def _comments(meta: _Meta) -> tuple[str, ...]:
    """How it was trained: by the key model, which older files call antialias."""
    model = meta.get("model", meta.get("antialias"))
    return (render_mode.ANTIALIASED,) if model is True or str(model).lower() == "antialiased" else ()


def _part(meta: _Meta, name: str) -> _Meta:
    if not isinstance(part := meta.get(name), dict):
        raise InputError(f"{META}: expected an object {name}, got {shown(part)}; this is no SOG")
    return part


def _count(meta: _Meta) -> Any:
    """The number of Gaussians; version 1 has it as the first number of a shape."""
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
    """A list of `count` finite numbers, or one for all; float64 [count]."""
    values = part.get(name)
    values = values if isinstance(values, list) else [values] * count
    if not is_row(values, count) or not all(type(value) in (int, float) and abs(value) < 1e30 for value in values):
        raise InputError(f"{META}: {name}: expected {count} finite numbers, got {shown(part.get(name))}")
    return np.array(values, np.float64)


def _values(part: _Meta, stored: np.ndarray, channels: int = 3) -> np.ndarray:
    """What the bytes [N, 3] stand for, by a codebook or between extremes of so many channels."""
    if "codebook" in part:
        return _numbers(part, "codebook", 256)[stored]
    low, high = (_numbers(part, end, channels)[:3] for end in ("mins", "maxs"))
    return low + (high - low) * (stored / 255)


def _centres(files: SogFiles, part: _Meta, count: int) -> np.ndarray:
    lower, upper = (files.image(_file(part, index), count)[:count, :3].astype(np.int64) for index in (0, 1))
    low, high = (_numbers(part, end, 3) for end in ("mins", "maxs"))
    if max(np.abs(low).max(), np.abs(high).max()) > _FARTHEST:
        raise InputError(f"{META}: means: expected logarithms of 1 + |x| within {_FARTHEST:g}; its extremes are wrong")
    logs = low + (high - low) * ((upper << 8 | lower) / 65535)
    return np.sign(logs) * np.expm1(np.abs(logs))


def _rotations(stored: np.ndarray) -> np.ndarray:
    if (bad := stored[:, 3] < _LEAST_MODE).any():
        index = int(bad.argmax())
        raise InputError(f"quats: expected alpha 252..255, got {stored[index, 3]} of Gaussian {index}; a wrong image")
    return completed((stored[:, :3] / 255 - 0.5) * math.sqrt(2), stored[:, 3].astype(np.int64) - _LEAST_MODE)


def _harmonics(files: SogFiles, part: _Meta, count: int) -> np.ndarray:
    """Coefficients above degree 0, [N, K - 1, 3]."""
    labels = files.image(_file(part, 1), count)[:count].astype(np.int64)
    labels = labels[:, 0] | labels[:, 1] << 8
    entries = whole_number("shN: count", part.get("count", int(labels.max()) + 1), 1, _MOST_ENTRIES)
    if int(labels.max()) >= entries:
        raise InputError(f"shN: expected labels below {entries}, got {labels.max()}; a wrong image or count")
    bands = whole_number("shN: bands", part["bands"] if "bands" in part else _bands(part), 1, len(_COEFFICIENTS))
    each, rows = _COEFFICIENTS[bands], -(-entries // _IN_A_ROW)
    width = _IN_A_ROW * each
    palette = files.image(_file(part, 0), width * rows, width)[: width * rows, :3].reshape(-1, 3)
    return _values(part, palette).reshape(-1, each, 3)[labels]


def _bands(part: _Meta) -> Any:
    """Of version 1, which has the number of coefficients of three channels in a shape."""
    shape = part.get("shape")
    sizes = {each: b for b, each in _COEFFICIENTS.items()} | {3 * each: bands for bands, each in _COEFFICIENTS.items()}
    return sizes.get(shape[-1]) if isinstance(shape, list) and shape and isinstance(shape[-1], int) else None
