"""The container of glTF 2.0, .glb or .gltf: its objects, the numbers in its accessors, and the nodes of its scene.

Specification: Khronos, "glTF 2.0". A .glb has a header of 12 bytes, a chunk of JSON and a chunk of binary data. A .gltf
is the JSON, with data in files beside it or in data: URIs. Numbers are views of mapped files, without a copy.
"""

from __future__ import annotations

import base64
import binascii
import struct
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from lightfield_gs.base.checks import is_row, real_number, shown, whole_number
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.atomic import checked_path
from lightfield_gs.io.file_kinds import refuse_stand_in
from lightfield_gs.io.text_files import decode_text, parse_json

MAGIC = b"glTF"
JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_MOST_JSON_BYTES = 1 << 30
_MOST = (1 << 53) - 1
_NUMBER_KINDS: dict[Any, str] = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS: dict[Any, int] = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_CUT = "it is cut or damaged: download or export it again"
_COMPRESSED = "export it without compression, or as .ply"
Object = dict[str, Any]


class GltfFile:
    """A file of glTF.

    Attributes:
        path: the file.
        root: its JSON.

    Raises:
        InputError: the file is no glTF 2.0, or is cut; messages do not name it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._buffers: dict[int, np.ndarray] = {}
        self._binary: np.ndarray | None = None
        with reading(path), open(path, "rb") as file:
            is_binary = file.read(4) == MAGIC
        text = self._read_chunks() if is_binary else self._read_text()
        try:
            self.root = parse_json(decode_text(text))
        except ValueError as error:
            raise InputError(f"it is no glTF: its JSON cannot be read ({' '.join(str(error).split())[:100]})") from None
        asset = self.root.get("asset") if isinstance(self.root, dict) else None
        version = asset.get("version") if isinstance(asset, dict) else None
        if not isinstance(version, str) or not version.startswith("2."):
            raise InputError(f"expected glTF of version 2, got {shown(version)}; export it as glTF 2.0 or .ply")

    def _read_text(self) -> bytes:
        if self.path.stat().st_size > _MOST_JSON_BYTES:
            raise InputError(f"expected at most {_MOST_JSON_BYTES} bytes of JSON; it is no .gltf, or export a .glb")
        refuse_stand_in(self.path)
        return self.path.read_bytes()

    def _read_chunks(self) -> bytes:
        """Return the JSON of a .glb, and map its binary data."""
        data = np.memmap(self.path, np.uint8, "r")
        if len(data) < HEADER.size + CHUNK.size:
            raise InputError(f"a .glb has a header of {HEADER.size + CHUNK.size} bytes, and it has {len(data)}; {_CUT}")
        _, version, length = HEADER.unpack_from(data.data)
        if version != 2:
            raise InputError(f"expected glTF of version 2, got {version}; export it as glTF 2.0 or .ply")
        if length > len(data):
            raise InputError(f"its header promises {length} bytes, and there are {len(data)}; {_CUT}")
        size, kind = CHUNK.unpack_from(data.data, HEADER.size)
        start = HEADER.size + CHUNK.size
        if kind != JSON_CHUNK or start + size > length:
            raise InputError(f"expected a chunk of JSON, got {size} bytes of {shown(kind)}; {_CUT}")
        text = data[start : start + size].tobytes()
        start += size
        if start + CHUNK.size <= length:
            size, kind = CHUNK.unpack_from(data.data, start)
            if start + CHUNK.size + size > length:
                raise InputError(f"its binary chunk ends behind the file's end; {_CUT}")
            if kind == BINARY_CHUNK:
                self._binary = data[start + CHUNK.size :][:size]
        return text

    def item(self, kind: str, index: Any) -> Object:
        """Return an object of a list of the root; raise InputError for other indices and values."""
        items = self.root.get(kind)
        items = items if isinstance(items, list) else []
        found = items[whole_number(f"an index of {kind}", index, 0, max(len(items) - 1, 0))] if items else None
        if not isinstance(found, dict):
            raise InputError(f"expected an object {kind}[{shown(index)}], got {shown(found)}; {_CUT}")
        return found

    def _buffer(self, index: int) -> np.ndarray:
        """Return the bytes of a buffer."""
        if index not in self._buffers:
            buffer = self.item("buffers", index)
            size = whole_number("buffers: byteLength", buffer.get("byteLength"), 1, _MOST)
            data = self._binary if "uri" not in buffer and index == 0 else _located(self.path, buffer.get("uri"))
            if data is None or len(data) < size:
                raise InputError(
                    f"buffer {index}: expected {size} bytes, got {'none' if data is None else len(data)}; {_CUT}"
                )
            self._buffers[index] = data[:size]
        return self._buffers[index]

    def view(self, index: Any) -> tuple[np.ndarray, int | None]:
        """Return the bytes of a buffer view, and its stride in bytes, if it has one."""
        view = self.item("bufferViews", index)
        if compressed := [name for name in extensions(view) if "compression" in name]:
            raise InputError(f"its data are compressed by {compressed[0]}, which is not read; {_COMPRESSED}")
        data = self._buffer(whole_number("bufferViews: buffer", view.get("buffer"), 0, _MOST))
        start = whole_number("bufferViews: byteOffset", view.get("byteOffset", 0), 0, _MOST)
        size = whole_number("bufferViews: byteLength", view.get("byteLength"), 1, _MOST)
        if start + size > len(data):
            raise InputError(f"buffer view {index} ends behind its buffer of {len(data)} bytes; {_CUT}")
        stride = view.get("byteStride")
        return data[start : start + size], None if stride is None else whole_number("byteStride", stride, 1, 252)

    def numbers(self, index: Any, what: str) -> np.ndarray:
        """Return the numbers [count, width] of an accessor.

        Integers that are normalized become float32 within -1..1 or 0..1; others keep their type.
        """
        accessor = self.item("accessors", index)
        count = whole_number(f"{what}: count", accessor.get("count"), 1, _MOST)
        kind, width = _NUMBER_KINDS.get(accessor.get("componentType")), _WIDTHS.get(accessor.get("type"))
        if kind is None or width is None:
            raise InputError(
                f"{what}: expected numbers of one to four columns, got {shown(accessor.get('type'))} of componentType "
                f"{shown(accessor.get('componentType'))}; {_CUT}"
            )
        if "sparse" in accessor:
            raise InputError(f"{what}: sparse accessors are not read; {_COMPRESSED}")
        if "bufferView" not in accessor:
            needed = ", ".join(map(str, self.root.get("extensionsRequired") or ())) or "an extension that is not read"
            raise InputError(f"{what}: there are no data, which {needed} may hold; {_COMPRESSED}")
        data, stride = self.view(accessor["bufferView"])
        dtype = np.dtype(kind)
        row = dtype.itemsize * width
        start = whole_number(f"{what}: byteOffset", accessor.get("byteOffset", 0), 0, _MOST)
        end = start + (stride or row) * (count - 1) + row
        if end > len(data):
            raise InputError(f"{what}: {count} rows end at byte {end} of a view of {len(data)} bytes; {_CUT}")
        found = np.ndarray((count, width), dtype, data, start, (stride or row, dtype.itemsize))
        if accessor.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(found.astype(np.float32) / np.float32(np.iinfo(dtype).max), -1)
        return found

    def placed_nodes(self) -> Iterator[tuple[Object, np.ndarray]]:
        """Yield the nodes of the scene that is shown, and their matrices [4, 4] to the scene, float64."""
        nodes = self.root.get("nodes")
        nodes = nodes if isinstance(nodes, list) else []
        if self.root.get("scenes"):
            roots = self.item("scenes", self.root.get("scene", 0)).get("nodes", [])
        else:
            children = {child for node in nodes if isinstance(node, dict) for child in _indices(node.get("children"))}
            roots = [index for index in range(len(nodes)) if index not in children]
        left = [(index, np.eye(4)) for index in reversed(_indices(roots))]
        seen = set()
        while left:
            index, above = left.pop()
            node = self.item("nodes", index)
            if index in seen:
                raise InputError(f"node {index} has several parents, and a scene is a tree; export it again")
            seen.add(index)
            matrix = above @ _node_matrix(node)
            yield node, matrix
            left += [(child, matrix) for child in reversed(_indices(node.get("children")))]


def extensions(item: Object) -> Object:
    """Return the extensions of an object of glTF by name."""
    found = item.get("extensions")
    return found if isinstance(found, dict) else {}


def _indices(values: Any) -> list[int]:
    """Return a list of indices; raise InputError for other values."""
    if values is None:
        return []
    if not is_row(values):
        raise InputError(f"expected a list of nodes, got {shown(values)}; {_CUT}")
    return [whole_number("a node", value, 0, _MOST) for value in values]


def _node_matrix(node: Object) -> np.ndarray:
    """Return the matrix [4, 4] of a node to its parent, float64."""
    if "matrix" in node:
        matrix = _row(node, "matrix", 16, ()).reshape(4, 4).T
        if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
            raise InputError(f"a node's matrix: expected the last row 0, 0, 0, 1, got {shown(matrix[3].tolist())}")
        return matrix
    turn = _row(node, "rotation", 4, (0, 0, 0, 1))
    length = float(np.linalg.norm(turn))
    if not length:
        raise InputError("a node's rotation: expected a quaternion of any length but zero, got 0, 0, 0, 0")
    x, y, z, w = turn / length
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= _row(node, "scale", 3, (1, 1, 1))
    matrix[:3, 3] = _row(node, "translation", 3, (0, 0, 0))
    return matrix


def _row(node: Object, name: str, count: int, default: tuple[int, ...]) -> np.ndarray:
    """Return numbers of a node, float64 [count]."""
    values = node.get(name, default)
    if not is_row(values, count):
        raise InputError(f"a node's {name}: expected {count} numbers, got {shown(values)}")
    return np.array([real_number(f"a node's {name}", value, -1e30, 1e30) for value in values])


def _located(path: Path, uri: Any) -> np.ndarray | None:
    """Return the bytes at the URI of a buffer: a data: URI, or a file in the folder of the .gltf."""
    if not isinstance(uri, str):
        return None
    if uri.startswith("data:"):
        kind, _, text = uri.partition(",")
        if not kind.endswith(";base64"):
            raise InputError(f"buffer: expected data in base64, got {shown(kind)}; export a .glb")
        try:
            return np.frombuffer(base64.b64decode(text, validate=True), np.uint8)
        except (binascii.Error, ValueError):
            raise InputError(f"buffer: its base64 is broken; {_CUT}") from None
    name = unquote(uri)
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or "\\" in name or ":" in name or PurePosixPath(name).is_absolute():
        raise InputError(f"buffer: expected the name of a file beside it, got {shown(uri)}")
    file = checked_path(path.parent.joinpath(*parts))
    if not file.is_file() or not file.stat().st_size:
        raise InputError(f"its data are in {shown(name)}, which is not beside it; put it there, or export a .glb")
    with reading(file):
        return np.memmap(file, np.uint8, "r")
