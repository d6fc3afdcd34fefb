"""What the captures of make_captures show: solids or meshes in a room, and scenes of Gaussians."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch

from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.io.scenes.files import read_scene
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from training.data.procedural_plan import GROUPS, LOOK, draw_looks, rotation
from training.data.textures import SKIN
from training.data.uniform import Numbers
from training.meshes.pack import INDEX, Meshes, ResidentMeshes, join_meshes, plain_mesh, read_meshes
from training.meshes.rasterize import list_draws
from training.meshes.render import Looks, Scene, render_pictures
from training.meshes.scenes import standard_light
from training.meshes.shade import OWN

_OBJECTS = 9  # the first of them in the middle
_ROOM, _HEIGHT = 5.2, 3.2  # sides of its floor, and its height, scene units
_MIDDLE = np.array([0, 0.3, 0])  # that the cameras look at, 1.7 away, from 15 degrees above it
_DISTANCE, _TILT_DEG = 1.7, 15.0
_CELLS = 24  # along each side of a wall: the renderer leaves out triangles that reach behind the camera
_LOOK_NUMBERS = 400  # uniform numbers of an object's look, at most
_HALF_LENGTH = 0.4  # of an object, for the waves of its pattern
_UPRIGHT = np.diag([1.0, -1.0, -1.0])  # from axes with y up, z backwards to those of a camera


class Stage(Protocol):
    """Something to photograph.

    Attributes:
        centre: [4,4], world_to_camera of the camera in the middle.
        distance: from it to the point that all cameras look at, on its axis.
        tilt_deg: how far the camera in the middle looks down; the others go round the upright axis.
    """

    centre: np.ndarray
    distance: float
    tilt_deg: float

    def photograph(self, pose: np.ndarray, focal_px: float, size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the image [H,W,3] in 0..1 and the depth [H,W], 0 where nothing is, before world_to_camera [4,4]."""


class Room:
    """A room of patterned walls with objects on its floor, lit from above."""

    def __init__(self, seed: int, folder: Path | None = None) -> None:
        """Draw a room.

        Args:
            seed: of the objects, their places, and the patterns.
            folder: of mesh packs, whose split "train" has the objects; None: they are superellipsoids.

        Raises:
            InputError: the folder has no packs.
        """
        rng = np.random.default_rng(seed)
        walls = [plain_mesh(f"wall {number}", *_grid(_wall), _triangles(_CELLS, _CELLS)) for number in range(6)]
        meshes = _solids(rng, walls) if folder is None else _pack_objects(rng, folder, walls)
        self._meshes, self._objects = ResidentMeshes(meshes), np.arange(len(meshes))
        self._to_world = np.concatenate([_places(rng, meshes), _wall_places()])
        self._looks = _looks(rng, meshes)
        self.distance, self.tilt_deg = _DISTANCE, _TILT_DEG
        self.centre = np.eye(4)
        self.centre[:3, :3] = rotation(0, np.radians(self.tilt_deg)) @ _UPRIGHT
        self.centre[:3, 3] = (0, 0, self.distance) - self.centre[:3, :3] @ _MIDDLE

    def photograph(self, pose: np.ndarray, focal_px: float, size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """See Stage."""
        width, height = size_px
        side, top = max(size_px), (max(size_px) - height) // 2
        left = (side - width) // 2
        to_camera = pose[:3, :3] @ self._to_world
        to_camera[..., 3] += pose[:3, 3]
        scene = Scene(
            list_draws(self._meshes.meshes, self._objects, np.zeros(len(self._objects), int), 1),
            torch.from_numpy(to_camera).float(),
            torch.tensor([[focal_px, focal_px, left + width / 2, top + height / 2]]),
            torch.from_numpy(standard_light(pose[None, :3, :3])).float(),
            side,
            self._looks,
        )
        pictures = render_pictures(self._meshes, scene)
        cut = slice(top, top + height), slice(left, left + width)
        return pictures.images[0, :3].permute(1, 2, 0)[cut].numpy(), pictures.depth[0][cut].numpy()


def _places(rng: np.random.Generator, meshes: Meshes) -> np.ndarray:
    """Return [O,3,4] that put objects on the floor, the first in the middle, the others round it."""
    out = np.zeros((_OBJECTS, 3, 4))
    for number in range(_OBJECTS):
        size = 1.0 if number == 0 else rng.uniform(0.35, 0.65)
        angle = 2 * np.pi * (number + rng.uniform(-0.3, 0.3)) / (_OBJECTS - 1)
        radius = 0.0 if number == 0 else rng.uniform(0.65, 0.95)
        out[number, :, :3] = size * rotation(1, rng.uniform(-np.pi, np.pi))
        lowest = meshes.positions[meshes.vertices[number] : meshes.vertices[number + 1], 1].min()
        out[number, :, 3] = radius * np.sin(angle), -size * lowest, radius * np.cos(angle)
    return out


def _wall_places() -> np.ndarray:
    """Return [6,3,4] for floor, ceiling and walls, from squares of side 1 in x and z."""
    half = _ROOM / 2
    out = np.zeros((6, 3, 4))
    out[:2, 0, 0], out[:2, 2, 2], out[:2, 1, 1] = _ROOM, _ROOM, 1
    out[1, 1, 3] = _HEIGHT
    for number, (along, across, side) in enumerate(((0, 2, half), (0, 2, -half), (2, 0, half), (2, 0, -half)), 2):
        out[number, along, 0], out[number, 1, 2], out[number, across, 1] = _ROOM, _HEIGHT, 1
        out[number, 1, 3], out[number, across, 3] = _HEIGHT / 2, side
    return out


def _looks(rng: np.random.Generator, meshes: Meshes) -> Looks:
    """Return random patterns of objects without colours of their own; the others keep theirs."""
    count = len(meshes)
    patterns = draw_looks(Numbers(rng.random((count, _LOOK_NUMBERS))))
    patterns[..., 6:15] /= _HALF_LENGTH
    patterns[..., 3:6] = np.roll(patterns[..., :3], 1, axis=0)  # the second colour is another object's first
    weights = sum(list(LOOK.values())[: list(LOOK).index("weights")])
    patterns[..., weights : weights + LOOK["weights"]] = 0
    patterns[..., weights + 1 : weights + 5] = rng.dirichlet(
        np.full(4, 0.5), patterns.shape[:2]
    )  # structure from motion needs patterns
    patterns[..., -1] = 0  # without gloss
    keeps = {"weight": [0.0], "order": [0.0, 1.0, 2.0], "gain": [1.0, 1.0, 1.0], "gamma": [1.0]}
    own = np.tile(np.concatenate([keeps[name] for name in OWN]), (count, GROUPS, 1))
    own[..., 0] = ~meshes.grey[:, None]
    rows = (torch.from_numpy(values.reshape(count * GROUPS, -1)).float() for values in (own, patterns))
    return Looks(torch.arange(count) * GROUPS, *rows, torch.zeros(count * GROUPS, sum(SKIN.values())))


def _solids(rng: np.random.Generator, walls: list[dict[str, Any]]) -> Meshes:
    solids = []
    for number in range(_OBJECTS):
        half, exponents = rng.uniform(0.4, 1, 3), rng.uniform(0.3, 1.3, 2)
        half /= 2 * np.linalg.norm(half)

        def solid(u: np.ndarray, v: np.ndarray, half=half, exponents=exponents) -> tuple[np.ndarray, np.ndarray]:
            return _superellipsoid(u, v, half, exponents)

        solids.append(plain_mesh(f"solid {number}", *_grid(solid), _triangles(_CELLS, _CELLS)))
    return join_meshes([*solids, *walls])


def _pack_objects(rng: np.random.Generator, folder: Path, walls: list[dict[str, Any]]) -> Meshes:
    index = folder / INDEX
    with reading(index), open(index, newline="", encoding="utf-8") as file:
        names = [row.get("name", "") for row in csv.DictReader(file) if row.get("split") == "train"]
    if len(names) < _OBJECTS:
        raise InputError(f"{index}: expected {_OBJECTS} objects of the split train or more, got {len(names)}")
    return read_meshes(folder, names=rng.choice(names, _OBJECTS, replace=False).tolist(), more=walls)


def _grid(surface: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and normals, float32 [N,3], of a surface at places of 0..1 x 0..1, row by row."""
    places = np.linspace(0, 1, _CELLS + 1)
    u, v = (values.ravel() for values in np.meshgrid(places, places, indexing="ij"))
    positions, normals = surface(u, v)
    return positions.astype(np.float32), normals.astype(np.float32)


def _wall(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    flat = np.stack([u - 0.5, np.zeros_like(u), v - 0.5], 1)
    return flat, np.broadcast_to([0.0, 1.0, 0.0], flat.shape)


def _superellipsoid(
    u: np.ndarray, v: np.ndarray, half: np.ndarray, exponents: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and unit normals [N,3]: Barr, "Superquadrics and angle-preserving transformations", 1981."""
    angles = np.pi * (u - 0.5), 2 * np.pi * (v - 0.5)

    def terms(powers: np.ndarray) -> np.ndarray:
        (c1, s1), (c2, s2) = (
            [np.sign(wave) * np.abs(wave) ** power for wave in (np.cos(angle), np.sin(angle))]
            for angle, power in zip(angles, powers)
        )
        return np.stack([c1 * c2, s1, c1 * s2], 1)

    normals = terms(2 - exponents) / half
    return half * terms(exponents), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _triangles(rows: int, columns: int) -> np.ndarray:
    """Return the triangles int32 [2 rows columns,3] of a grid of cells."""
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    below = first + columns + 1
    triangles = np.stack([first, below, first + 1, below, below + 1, first + 1], 1)
    return triangles.reshape(-1, 3).astype(np.int32)


@dataclass
class GaussianStage:
    """A scene of Gaussians before white, from the camera that a panel would show it by."""

    scene: Any
    centre: np.ndarray
    distance: float
    tilt_deg: float = 0.0

    @classmethod
    def read(cls, path: Path) -> GaussianStage:
        """Read the scene in a file. Raises InputError."""
        scene = read_scene(path).gaussians
        rig = Rig.frame(scene, Panel.load(DEFAULT_PANEL))
        return cls(scene, np.asarray(rig.world_to_camera), rig.zero_depth)

    def photograph(self, pose: np.ndarray, focal_px: float, size_px: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """See Stage."""
        width, height = size_px
        focal, middle = torch.tensor([[focal_px, focal_px]]), torch.tensor([[width / 2, height / 2]])
        cameras = Cameras(torch.from_numpy(pose).float()[None], focal, middle, width, height)
        drawn = render(self.scene, cameras, alpha=True, depth=True)
        assert drawn.alpha is not None and drawn.depth is not None
        depth = torch.where(drawn.alpha[0] > 0.5, drawn.depth[0], 0)
        return drawn.image[0].clamp(0, 1).numpy(), depth.numpy()
