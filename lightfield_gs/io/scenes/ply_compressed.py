"""The compressed .ply of SuperSplat: chunks of 256 Gaussians, each packed into 16 bytes between the chunk's extremes.

packed_position and packed_scale (logarithms) have 11, 10 and 11 bits, packed_color four bytes (colours and the opacity
itself), packed_rotation the index of the largest component of wxyz and the others of 10 bits within +-sqrt(1/2). An
element "sh" may hold f_rest_* as bytes, 0..255 for -4..4. Layout: PlayCanvas, splat-transform and engine.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.scenes.ply_header import Element, Header
from lightfield_gs.io.scenes.stored_scene import (
    StoredScene,
    completed,
    drawn_bands,
    expect_some,
    harmonics_of_colours,
    settled,
)

CHUNK = 256  # Gaussians
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = tuple(f"{end}_{what}{axis}" for what in ("", "scale_") for end in ("min", "max") for axis in "xyz")
_COLOURS = tuple(f"{end}_{name}" for end in ("min", "max") for name in "rgb")
_REST_COUNTS = (9, 24, 45, 72)
KIND = "compressed .ply (SuperSplat)"


def is_compressed(header: Header) -> bool:
    return any(element.name == "chunk" for element in header.elements)


def check_header(path: Path, header: Header) -> None:
    """Raises InputError unless the header is that of a compressed .ply with enough chunks."""
    elements = {element.name: element for element in reversed(header.elements)}
    vertex = elements.get("vertex", Element("vertex", 0, []))
    for element, names in ((elements["chunk"], _BOUNDS), (vertex, _PACKED)):
        kinds = {column.name: column.kind for column in element.properties if column.length_kind is None}
        if missing := [name for name in names if name not in kinds]:
            raise InputError(f"{path}: missing {', '.join(missing)}; expected the properties of a compressed .ply")
        if element is vertex and any(kinds[name] != "u4" for name in names):
            raise InputError(f"{path}: expected uint for {', '.join(names)}; export it again")
        if element.has_lists:
            raise InputError(f"{path}: element {element.name} has list properties; this is no compressed .ply")
    expect_some(path, vertex.count)
    if not vertex.count <= CHUNK * elements["chunk"].count:
        raise InputError(
            f"{path}: {elements['chunk'].count} chunks are too few for {vertex.count} Gaussians, {CHUNK} each; "
            "its header is wrong"
        )
    if "sh" in elements:
        _check_rest(path, elements["sh"], vertex.count)


def _check_rest(path: Path, element: Element, count: int) -> None:
    names = [column.name for column in element.properties]
    if len(names) not in _REST_COUNTS or names != [f"f_rest_{i}" for i in range(len(names))] or element.has_lists:
        raise InputError(
            f"{path}: element sh: expected f_rest_0 on, 9, 24, 45 or 72 of them, got {len(names)} properties"
        )
    if element.count != count or any(column.kind != "u1" for column in element.properties):
        raise InputError(f"{path}: element sh: expected a row of uchar for each of {count} Gaussians")


def scene(path: Path, header: Header, elements: dict[str, np.ndarray], skip_invalid: bool) -> StoredScene:
    """The Gaussians of elements whose header was checked. Raises InputError."""
    chunks, rows = elements.pop("chunk"), elements.pop("vertex")
    of = np.arange(len(rows)) // CHUNK
    rest, left_out = drawn_bands(_rest(elements.pop("sh", None), len(rows)))
    with np.errstate(over="ignore", invalid="ignore"):
        logs = _between(chunks, of, "scale_", _eleven_ten_eleven(rows["packed_scale"]))
        colours = _bytes(rows["packed_color"])
        rgb = colours[:, :3]
        if all(name in (chunks.dtype.names or ()) for name in _COLOURS):
            rgb = _between(chunks, of, "", rgb, "rgb")
        fields = {
            "means": _between(chunks, of, "", _eleven_ten_eleven(rows["packed_position"])),
            "quaternions": _rotations(rows["packed_rotation"]),
            "scales": np.exp(logs),
            "opacities": colours[:, 3],
            "sh": np.concatenate([harmonics_of_colours(rgb)[:, None], rest], 1),
        }
    fields, notes = settled(path, fields, skip_invalid)
    return StoredScene(fields, comments=header.comments, elements=elements, notes=left_out + notes, kind=KIND)


def _between(chunks: np.ndarray, of: np.ndarray, prefix: str, shares: np.ndarray, axes: str = "xyz") -> np.ndarray:
    """Values [N, 3] at these shares 0..1 of the way between their chunk's extremes."""
    low, high = (
        np.stack([chunks[f"{end}_{prefix}{axis}"] for axis in axes], 1).astype(np.float64)[of] for end in ("min", "max")
    )
    return low + (high - low) * shares


def _eleven_ten_eleven(words: np.ndarray) -> np.ndarray:
    return np.stack([(words >> 21) / 2047, (words >> 11 & 1023) / 1023, (words & 2047) / 2047], 1)


def _bytes(words: np.ndarray) -> np.ndarray:
    return np.stack([(words >> shift & 255) / 255 for shift in (24, 16, 8, 0)], 1)


def _rotations(words: np.ndarray) -> np.ndarray:
    three = np.stack([(words >> shift & 1023) / 1023 for shift in (20, 10, 0)], 1)
    return completed((three - 0.5) * math.sqrt(2), words >> 30)


def _rest(rows: np.ndarray | None, count: int) -> np.ndarray:
    """Harmonics above degree 0, [N, K - 1, 3]."""
    if rows is None:
        return np.zeros((count, 0, 3))
    stored = np.stack([rows[name] for name in rows.dtype.names or ()], 1).astype(np.float64)
    shares = np.where(stored == 0, 0.0, np.where(stored == 255, 1.0, (stored + 0.5) / 256))
    return ((shares - 0.5) * 8).reshape(count, 3, -1).transpose(0, 2, 1)
