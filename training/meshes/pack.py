"""Mesh packs: objects as textured triangles in npz files, and an index that assigns each object to a split.

An object is centred, its bounding box has a diagonal of 1, and y points up. Colours are sRGB values. The packs store
differences of neighbouring numbers, which compress well; this module undoes that.
"""

from __future__ import annotations

import csv
import io
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from lightfield_gs.base.errors import InputError

INDEX = "index.csv"
SUPPORTS = 128  # points that stand for the outline of an object: its box is found to about 1 %
_CONSIDERED = 2048  # of an object's vertices when these are searched for
_GREY_LEVELS = 8  # a single material whose channels differ less has no colour of its own
_OFFSETS = ("vert_off", "tri_off", "mat_off", "uv_off", "col_off", "tex_off")
_ARRAYS = ("pos", "nrm", "uv", "uv_lo", "uv_ext", "col", "idx", "mat_tris", "mat_rgba", "mat_rect", "mat_cut", "tex_id")


@dataclass(frozen=True)
class Meshes:
    """O objects of N vertices, T triangles and M materials in all; numbers of an object's vertices count from 0.

    Attributes:
        names: Names of the objects.
        vertices, triangles, materials: [O+1], where the vertices, triangles and materials of each object begin.
        positions: float32 [N,3].
        normals: float32 [N,3], unit.
        uvs: float32 [N,2], 0 where there are none; (0, 0) is the upper left of a texture.
        colours: uint8 [N,3], white where there are none.
        corners: int32 [T,3], vertex numbers within the object.
        material_of: int32 [T], material numbers within the object.
        base_colours: float32 [M,3], 0..1.
        rectangles: int32 [M,6], (offset, stride, x, y, width, height). A texture's first texel, the texels of its row,
            and the material's rectangle in it. All 0: no texture.
        cut: bool [M], whether texels of less than half opacity are holes.
        texels: uint8 [P,4], all textures by rows.
        supports: float32 [O,3,SUPPORTS], the vertices that lie furthest in directions all round.
        grey: bool [O], whether an object has no colours of its own.
    """

    names: list[str]
    vertices: np.ndarray
    triangles: np.ndarray
    materials: np.ndarray
    positions: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    colours: np.ndarray
    corners: np.ndarray
    material_of: np.ndarray
    base_colours: np.ndarray
    rectangles: np.ndarray
    cut: np.ndarray
    texels: np.ndarray
    supports: np.ndarray
    grey: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def has_holes(self, objects: np.ndarray) -> bool:
        """Return whether any of these objects has a material with holes."""
        holes = np.concatenate([[0], np.cumsum(self.cut)])
        return bool((holes[self.materials[objects + 1]] > holes[self.materials[objects]]).any())


class ResidentMeshes:
    """Meshes on a device.

    Attributes:
        meshes: The meshes on the host.
        positions: float32 [N,3].
        attributes: float32 [N,8], normal, uv and colour of each vertex.
        corners, material_of, rectangles: int32, as in Meshes.
        base_colours, cut, texels: As in Meshes.
    """

    def __init__(self, meshes: Meshes, device: torch.device | str = "cpu") -> None:
        self.meshes = meshes
        colours = meshes.colours.astype(np.float32) / 255
        attributes = np.concatenate([meshes.normals, meshes.uvs, colours], 1)
        self.positions, self.attributes = (_tensor(values, device) for values in (meshes.positions, attributes))
        self.corners, self.material_of, self.rectangles, self.base_colours, self.cut, self.texels = (
            _tensor(getattr(meshes, name), device)
            for name in ("corners", "material_of", "rectangles", "base_colours", "cut", "texels")
        )

    @property
    def device(self) -> torch.device:
        """The device of the meshes."""
        return self.positions.device


def _tensor(values: np.ndarray, device: torch.device | str) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).to(device)


def read_meshes(
    folder: Path, split: str = "train", names: list[str] | None = None, more: Sequence[dict[str, Any]] = ()
) -> Meshes:
    """Return the objects of a split.

    Args:
        folder: Folder of packs with their index.
        split: Value of the index's column "split".
        names: Names of the wanted objects; None: all.
        more: Further objects, of plain_mesh, which come last.

    Raises:
        InputError: the folder has no index or pack that can be read, or no such object.
    """
    folder = Path(folder)
    wanted = _numbers(folder / INDEX, split, names)
    with ThreadPoolExecutor() as pool:
        packs = list(pool.map(lambda file: _read_pack(folder / file, wanted[file]), wanted))
    first = 1
    for objects, texels in packs:
        for one in objects:
            one["rectangles"][:, 0] += np.where(one["rectangles"][:, 4] > 0, first, 0)
        first += len(texels)
    return join_meshes([*(one for objects, _ in packs for one in objects), *more], [p[1] for p in packs])


def plain_mesh(name: str, positions: np.ndarray, normals: np.ndarray, corners: np.ndarray) -> dict[str, Any]:
    """Return the fields of Meshes of one object of one material without colours of its own.

    Args:
        name: Name of the object.
        positions, normals: float32 [N,3].
        corners: int32 [T,3].
    """
    return {
        "names": name,
        "positions": positions,
        "normals": normals,
        "uvs": np.zeros((len(positions), 2), np.float32),
        "colours": np.full((len(positions), 3), 255, np.uint8),
        "corners": corners,
        "material_of": np.zeros(len(corners), np.int32),
        "base_colours": np.ones((1, 3), np.float32),
        "rectangles": np.zeros((1, 6), np.int32),
        "cut": np.zeros(1, bool),
        "supports": _supports(positions).T,
        "grey": True,
    }


def _read_pack(path: Path, numbers: list[int]) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Return the wanted objects of a pack, and their texels [P,4], from which rectangles count."""
    pack = _Pack(path)
    objects = [pack.read(number) for number in numbers]
    return objects, np.concatenate([np.zeros((0, 4), np.uint8), *pack.texels])


def _numbers(index: Path, split: str, names: list[str] | None) -> dict[str, list[int]]:
    """Return the numbers of the wanted objects in each pack."""
    if not index.is_file():
        raise InputError(f"{index}: expected an index of mesh packs, found no such file")
    found: dict[str, list[int]] = defaultdict(list)
    with open(index, newline="", encoding="utf-8") as file:
        rows = csv.DictReader(file)
        if missing := {"file", "i", "name", "split"} - set(rows.fieldnames or ()):
            raise InputError(
                f"{index}: expected the columns file, i, name, split, found no {', '.join(sorted(missing))}"
            )
        for row in rows:
            if row["split"] == split and (names is None or row["name"] in names):
                found[row["file"]].append(int(row["i"]))
    if not found:
        raise InputError(f"{index}: expected objects of the split {split}, found none")
    return found


def _undo_differences(planes: np.ndarray) -> np.ndarray:
    """Return uint16 [N,K] of planes [2K,N]: K rows of high bytes, then K of low ones, of differences."""
    high, low = np.split(planes.astype(np.uint16), 2)
    return np.cumsum((high << 8) + low, axis=1, dtype=np.uint16).T


def _vertex_numbers(planes: np.ndarray) -> np.ndarray:
    """Return vertex numbers int64 [3T] of planes [3,3T]: 0 is the next new vertex, n the one n before it."""
    code = planes.astype(np.int64)
    back = (code[0] << 16) + (code[1] << 8) + code[2]
    return np.cumsum(back == 0) - (back == 0) - back


def _unit_normals(octahedral: np.ndarray) -> np.ndarray:
    """Return unit vectors [N,3] of their octahedral coordinates int8 [N,2] (Cigolle et al. 2014)."""
    xy = octahedral.astype(np.float32) / 127
    z = 1 - np.abs(xy).sum(1, keepdims=True)
    folded = np.maximum(-z, 0) * np.where(xy >= 0, 1, -1)
    normals = np.concatenate([xy - folded, z], 1)
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)


class _Pack:
    """One npz file; `texels` collects the textures of the objects that are read."""

    def __init__(self, path: Path) -> None:
        try:
            with np.load(path) as file:
                self._stored = {name: file[name] for name in (*_OFFSETS, *_ARRAYS, "name", "tex")}
        except (OSError, ValueError, KeyError) as error:
            raise InputError(f"{path}: expected a mesh pack, could not read it: {error}") from None
        stored = self._stored
        self._positions, self._uvs = (_undo_differences(stored[name]) for name in ("pos", "uv"))
        self._normals = np.cumsum(stored["nrm"], axis=1, dtype=np.uint8).T.view(np.int8)
        self._colours = np.cumsum(stored["col"], axis=1, dtype=np.uint8).T
        self._corners = _vertex_numbers(stored["idx"]).reshape(-1, 3)
        self._first_texel = 0
        self._places: dict[int, tuple[int, int]] = {}
        self.texels: list[np.ndarray] = []

    def _rows(self, name: str, number: int) -> slice:
        return slice(*self._stored[f"{name}_off"][number : number + 2])

    def _texture(self, number: int) -> tuple[int, int]:
        """Return the first texel of a texture, and the texels of its row."""
        if number not in self._places:
            data = self._stored["tex"][self._rows("tex", number)].tobytes()
            image = np.asarray(Image.open(io.BytesIO(data)).convert("RGBA"))
            self._places[number] = self._first_texel, image.shape[1]
            self.texels.append(image.reshape(-1, 4))
            self._first_texel += image.shape[0] * image.shape[1]
        return self._places[number]

    def read(self, number: int) -> dict[str, Any]:
        """Return the fields of Meshes of one object."""
        stored = self._stored
        vertices, triangles, materials = (self._rows(name, number) for name in ("vert", "tri", "mat"))
        positions = (self._positions[vertices] / 65535 - 0.5).astype(np.float32)
        uvs, colours = np.zeros((len(positions), 2), np.float32), np.full((len(positions), 3), 255, np.uint8)
        if len(own := self._uvs[self._rows("uv", number)]):
            uvs = (stored["uv_lo"][number] + stored["uv_ext"][number] * (own / 65535)).astype(np.float32)
        if coloured := len(own := self._colours[self._rows("col", number)]):
            colours = own[:, :3]
        rectangles = np.zeros((materials.stop - materials.start, 6), np.int32)
        if (texture := int(stored["tex_id"][number])) >= 0:
            rectangles[:, :2], rectangles[:, 2:] = self._texture(texture), stored["mat_rect"][materials]
            rectangles[rectangles[:, 4] == 0] = 0
        base = stored["mat_rgba"][materials, :3]
        spread = int(base.max(1)[0]) - int(base.min(1)[0])
        return {
            "names": str(stored["name"][number]),
            "positions": positions,
            "normals": _unit_normals(self._normals[vertices]),
            "uvs": uvs,
            "colours": colours,
            "corners": (self._corners[triangles] - vertices.start).astype(np.int32),
            "material_of": np.repeat(np.arange(len(base), dtype=np.int32), stored["mat_tris"][materials]),
            "base_colours": base.astype(np.float32) / 255,
            "rectangles": rectangles,
            "cut": stored["mat_cut"][materials] > 0,
            "supports": _supports(positions).T,
            "grey": len(base) == 1 and not coloured and texture < 0 and spread <= _GREY_LEVELS,
        }


def _directions() -> np.ndarray:
    """Return unit vectors [SUPPORTS,3], evenly spread (a Fibonacci sphere)."""
    number = np.arange(SUPPORTS) + 0.5
    angle, height = np.pi * (1 + 5**0.5) * number, 1 - 2 * number / SUPPORTS
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], -1).astype(np.float32)


_DIRECTIONS = _directions()


def _supports(positions: np.ndarray) -> np.ndarray:
    """Return the vertices [SUPPORTS,3] that lie furthest in directions all round; all of them where they are few.

    Of many vertices it considers a part, spread over the object, and those that the box touches.
    """
    if len(positions) <= SUPPORTS:
        return positions[np.arange(SUPPORTS) % len(positions)]
    outermost = positions[np.concatenate([positions.argmin(0), positions.argmax(0)])]
    considered = np.concatenate([outermost, positions[:: -(-len(positions) // _CONSIDERED)]])
    return considered[(_DIRECTIONS @ considered.T).argmax(1)]


def join_meshes(objects: Sequence[dict[str, Any]], texels: Sequence[np.ndarray] = ()) -> Meshes:
    """Return Meshes of the fields of each object.

    Args:
        objects: Objects of packs, and of plain_mesh.
        texels: [P,4] of each pack, from the second texel of all on.
    """
    nothing = np.zeros((1, 4), np.uint8)  # for materials without a texture

    def starts(name: str) -> np.ndarray:
        return np.cumsum([0, *(len(one[name]) for one in objects)])

    joined = ("positions", "normals", "uvs", "colours", "corners", "material_of", "base_colours", "rectangles", "cut")
    return Meshes(
        names=[one["names"] for one in objects],
        vertices=starts("positions"),
        triangles=starts("corners"),
        materials=starts("base_colours"),
        texels=np.concatenate([nothing, *texels]),
        supports=np.stack([one["supports"] for one in objects]),
        grey=np.array([one["grey"] for one in objects]),
        **{name: np.concatenate([one[name] for one in objects]) for name in joined},
    )
