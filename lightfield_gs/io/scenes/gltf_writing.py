"""Write Gaussians as glTF 2.0 (KHR_gaussian_splatting): a .glb, or a .gltf with its data inside.

The axes are turned as gltf.py turns them back. Each attribute has a part of the buffer to itself, for simple readers.
An origin becomes the place of the node, in double precision. Comments are in the asset's extras.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

import lightfield_gs
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_COEFFICIENTS, SH_CONSTANT
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.scenes.comments import is_antialiased
from lightfield_gs.io.scenes.gltf import GAUSSIANS, SRGB
from lightfield_gs.io.scenes.gltf_file import BINARY_CHUNK, CHUNK, HEADER, JSON_CHUNK, MAGIC
from lightfield_gs.io.scenes.scene_arrays import Y_UP_SIGNS, Y_UP_TURN, Fields, Origin, up_losses

_FLOAT, _BYTE = 5126, 5121  # componentType
_AT_ONCE = 1 << 16  # Gaussians
_MOST_BYTES = (1 << 32) - 1  # of a .glb
_INSIDE = "data:application/octet-stream;base64,"
_Rows = Callable[[slice], np.ndarray]


def write(path: str | Path, fields: Fields, origin: Origin, comments: Sequence[str] = ()) -> list[str]:
    """Write float64 fields of N >= 1 valid Gaussians as float32; return losses, see files.write_arrays."""
    count, path = len(fields["means"]), Path(path)
    columns = _columns(fields)
    root, size = _describe(columns, count, fields["means"] * Y_UP_TURN, origin, comments)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        if path.suffix.lower() == ".gltf":
            _write_text(file, root, _blocks(columns, count))
        else:
            _write_chunks(path, file, root, size, _blocks(columns, count))
    lost = up_losses(comments, "glTF")
    if is_antialiased(comments):
        lost.append("glTF cannot say that it was trained with anti-aliasing: only this program reads it in the extras")
    return lost


def _columns(fields: Fields) -> dict[str, tuple[str, _Rows]]:
    """Return the attributes by name: their type, and a function of a slice that returns their numbers."""

    def turns(rows: slice) -> np.ndarray:
        wxyz = fields["quaternions"][rows] * np.append(1.0, Y_UP_TURN)
        return np.roll(wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True), -1, axis=1)

    def colours(rows: slice) -> np.ndarray:
        rgb = 0.5 + SH_CONSTANT * fields["sh"][rows, 0]
        rgba = np.concatenate([rgb, fields["opacities"][rows, None]], 1)
        return np.round(255 * rgba.clip(0, 1)).astype(np.uint8)

    def harmonic(index: int) -> _Rows:
        return lambda rows: fields["sh"][rows, index] * Y_UP_SIGNS[index]

    degree = SH_COEFFICIENTS.index(fields["sh"].shape[1])
    return {
        "POSITION": ("VEC3", lambda rows: fields["means"][rows] * Y_UP_TURN),
        f"{GAUSSIANS}:ROTATION": ("VEC4", turns),
        f"{GAUSSIANS}:SCALE": ("VEC3", lambda rows: fields["scales"][rows]),
        f"{GAUSSIANS}:OPACITY": ("SCALAR", lambda rows: fields["opacities"][rows]),
        "COLOR_0": ("VEC4", colours),
        **{
            f"{GAUSSIANS}:SH_DEGREE_{each}_COEF_{index}": ("VEC3", harmonic(each * each + index))
            for each in range(degree + 1)
            for index in range(2 * each + 1)
        },
    }


def _blocks(columns: dict[str, tuple[str, _Rows]], count: int) -> Iterator[bytes]:
    """Yield the bytes of the buffer."""
    for _, rows in columns.values():
        for start in range(0, count, _AT_ONCE):
            block = rows(slice(start, start + _AT_ONCE))
            yield (block if block.dtype == np.uint8 else block.astype("<f4")).tobytes()


def _describe(
    columns: dict[str, tuple[str, _Rows]], count: int, means: np.ndarray, origin: Origin, comments: Sequence[str]
) -> tuple[dict[str, Any], int]:
    """Return the JSON, and the size of the buffer in bytes; means: as they are written."""
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, int]] = []
    size = 0
    for kind, rows in columns.values():
        block = rows(slice(1))
        is_byte = block.dtype == np.uint8
        length = count * block.size * (1 if is_byte else 4)
        accessors.append(
            {
                "bufferView": len(views),
                "componentType": _BYTE if is_byte else _FLOAT,
                "count": count,
                "type": kind,
                **({"normalized": True} if is_byte else {}),
            }
        )
        views.append({"buffer": 0, "byteOffset": size, "byteLength": length})
        size += length
    for name, extreme in (("min", means.min(0)), ("max", means.max(0))):
        accessors[0][name] = extreme.astype(np.float32).tolist()
    place = {"translation": (np.array(origin) * Y_UP_TURN + 0.0).tolist()} if any(origin) else {}
    primitive = {
        "mode": 0,
        "attributes": {name: index for index, name in enumerate(columns)},
        "extensions": {GAUSSIANS: {"kernel": "ellipse", "colorSpace": SRGB}},
    }
    return {
        "asset": {
            "version": "2.0",
            "generator": f"lightfield-gs {lightfield_gs.__version__}",
            **({"extras": {"comments": list(comments)}} if comments else {}),
        },
        "extensionsUsed": [GAUSSIANS],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **place}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }, size


def _write_chunks(path: Path, file: BinaryIO, root: dict[str, Any], size: int, blocks: Iterator[bytes]) -> None:
    """Write a .glb; raise InputError for more data than its header can state."""
    text = json.dumps(root, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = HEADER.size + 2 * CHUNK.size + len(text) + size
    if length > _MOST_BYTES:
        raise InputError(f"cannot write {path}: a .glb holds 4 GiB at most, and this takes {length}; write a .ply")
    file.write(HEADER.pack(MAGIC, 2, length) + CHUNK.pack(len(text), JSON_CHUNK) + text)
    file.write(CHUNK.pack(size, BINARY_CHUNK))
    for block in blocks:
        file.write(block)


def _write_text(file: BinaryIO, root: dict[str, Any], blocks: Iterator[bytes]) -> None:
    """Write a .gltf with its data in base64."""
    root["buffers"][0]["uri"] = _INSIDE
    before, _, behind = json.dumps(root, indent=1).rpartition(_INSIDE)
    file.write((before + _INSIDE).encode())
    left = b""
    for block in blocks:
        left += block
        whole = len(left) - len(left) % 3
        file.write(base64.b64encode(left[:whole]))
        left = left[whole:]
    file.write(base64.b64encode(left) + behind.encode() + b"\n")
