"""Mesh packs as the tests need them: written number by number from the description of the format."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image

CUBE = np.array(list(np.ndindex(2, 2, 2))) - 0.5
CUBE_SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


@dataclass
class Mesh:
    """An object: positions [V,3] in -0.5..0.5, triangles [T,3], materials in order; normals: octahedral, int8 [V,2]."""

    positions: np.ndarray
    triangles: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    material_triangles: list[int] = field(default_factory=list)
    colours: list[tuple[int, int, int]] = field(default_factory=lambda: [(200, 60, 40)])
    rectangle: tuple[int, int, int, int] = (0, 0, 0, 0)
    cut: bool = False
    texture: np.ndarray | None = None


def cube(**changes) -> Mesh:
    """A cube in a box of unit diagonal, four vertices a side."""
    corners = (CUBE / 3**0.5)[CUBE_SIDES.ravel()]
    quads = np.arange(24).reshape(6, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Mesh(corners, triangles, **changes)


def _planes(values: np.ndarray) -> np.ndarray:
    """Differences of consecutive uint16 [N,K], high bytes and then low ones: uint8 [2K,N]."""
    steps = np.diff(values.astype(np.int64), axis=0, prepend=0) % 65536
    return np.concatenate([steps.T >> 8, steps.T & 255]).astype(np.uint8)


def _codes(triangles: np.ndarray) -> np.ndarray:
    """Vertex numbers [3T], each new one the next: vertices seen so far minus the number, 0 for a new one."""
    seen, codes = 0, []
    for vertex in triangles:
        codes.append(0 if vertex == seen else seen - vertex)
        seen += vertex == seen
    codes = np.array(codes)
    return np.stack([codes >> 16, codes >> 8 & 255, codes & 255]).astype(np.uint8)


def _in_order_of_use(mesh: Mesh) -> np.ndarray:
    """The vertices in the order in which triangles first name them."""
    _, first = np.unique(mesh.triangles.ravel(), return_index=True)
    return mesh.triangles.ravel()[np.sort(first)]


def write_packs(folder: Path, splits: dict[str, list[Mesh]]) -> None:
    """A pack for each split, and the index."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "index.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["file", "i", "name", "split"])
        for split, meshes in splits.items():
            np.savez_compressed(folder / f"{split}_00.npz", **_pack(split, meshes))
            rows.writerows([f"{split}_00.npz", number, f"{split}-{number}", split] for number in range(len(meshes)))


def _pack(split: str, meshes: list[Mesh]) -> dict[str, np.ndarray]:
    positions, triangles, normals, uvs, extents, textures, first = [], [], [], [], [], [b""], 0
    for mesh in meshes:
        order = _in_order_of_use(mesh)
        number = np.empty(len(mesh.positions), int)
        number[order] = np.arange(len(order))
        positions.append(np.rint((mesh.positions[order] + 0.5) * 65535))
        triangles.append(number[mesh.triangles].ravel() + first)
        normals.append(np.zeros((len(order), 2), np.int8) if mesh.normals is None else mesh.normals[order])
        uv = np.zeros((0, 2)) if mesh.uvs is None else mesh.uvs[order]
        low, extent = (uv.min(0), np.ptp(uv, 0)) if len(uv) else (np.zeros(2), np.zeros(2))
        uvs.append(np.rint((uv - low) / np.where(extent > 0, extent, 1) * 65535))
        extents.append((low, extent))
        first += len(order)
        if mesh.texture is not None:
            data = io.BytesIO()
            Image.fromarray(mesh.texture).save(data, "webp", lossless=True, exact=True)
            textures.append(data.getvalue())
    parts = [mesh.material_triangles or [len(mesh.triangles)] for mesh in meshes]

    def offsets(counts: list[int]) -> np.ndarray:
        return np.cumsum([0, *counts]).astype(np.int32)

    has_texture = np.array([mesh.texture is not None for mesh in meshes])
    joined = np.concatenate(normals).astype(np.int64)
    steps = np.diff(joined, axis=0, prepend=0) % 256
    return {
        "name": np.array([f"{split}-{number}" for number in range(len(meshes))]),
        "vert_off": offsets([len(one) for one in positions]),
        "tri_off": offsets([len(one) // 3 for one in triangles]),
        "mat_off": offsets([len(one) for one in parts]),
        "uv_off": offsets([len(one) for one in uvs]),
        "col_off": offsets([0] * len(meshes)),
        "pos": _planes(np.concatenate(positions)),
        "nrm": steps.T.astype(np.uint8),
        "uv": _planes(np.concatenate(uvs)),
        "uv_lo": np.array([low for low, _ in extents], np.float32),
        "uv_ext": np.array([extent for _, extent in extents], np.float32),
        "col": np.zeros((4, 0), np.uint8),
        "idx": _codes(np.concatenate(triangles)),
        "mat_tris": np.concatenate(parts).astype(np.int32),
        "mat_rgba": np.array([(*colour, 255) for mesh in meshes for colour in mesh.colours], np.uint8),
        "mat_mr": np.zeros((sum(map(len, parts)), 2), np.uint8),
        "mat_rect": np.array([mesh.rectangle for mesh in meshes for _ in mesh.colours], np.uint16),
        "mat_cut": np.array([mesh.cut for mesh in meshes for _ in mesh.colours], np.uint8),
        "tex_id": np.where(has_texture, np.cumsum(has_texture) - 1, -1).astype(np.int32),
        "tex_off": offsets([len(one) for one in textures[1:]]),
        "tex": np.frombuffer(b"".join(textures), np.uint8),
    }
