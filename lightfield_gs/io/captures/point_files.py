"""Points of a capture in .ply files: of other programs, and of scenes of Gaussians that were fitted before."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.captures.colmap import read_model
from lightfield_gs.io.captures.pinhole import nearest_rotation
from lightfield_gs.io.captures.shot import Shot
from lightfield_gs.io.ply_file import HEADER_LIMIT_BYTES, read_elements, read_header

_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")  # of a scene of Gaussians
# In lower case: nerfstudio's, COLMAP's and 3D Gaussian splatting's, and those of apps
_NAMES = ("sparse_pc.ply", "points3d.ply", "point_cloud.ply", "pointcloud.ply", "input.ply")
_CAMERAS_OFF = 0.02  # by which cameras of one photograph may differ, of their spread, and of their axes


def no_points() -> tuple[np.ndarray, np.ndarray]:
    """None: points [0,3] float64 and colours [0,3] uint8."""
    return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def points_beside(model: Path | None, folders: Sequence[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] float64 and colours [P,3] uint8 of a .ply that nothing names, in the world of the poses; says which.

    Args:
        model: a folder of COLMAP's files; a .ply there may have any name if it is the only one.
        folders: where one of the usual name is taken.
    """
    places = [*([] if model is None else [model]), *folders]
    for place in dict.fromkeys(places):
        with reading(place):
            files = sorted(path for path in place.iterdir() if path.suffix.lower() == ".ply" and path.is_file())
        usual = [path for name in _NAMES for path in files if path.name.lower() == name]
        found = usual or (files if place == model and len(files) == 1 else [])
        if found:
            try:
                points, colours = read_points(found[0])
            except InputError as error:
                assume(f"points beside the photographs are not used: {error}")
                continue
            assume(f"the {len(points)} points of {found[0]} are those of the scene: nothing else says where it is")
            return points, colours
    return no_points()


def points_of_model(model: Path, shots: Sequence[Shot], applied: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] float64 and colours [P,3] uint8 of a model that COLMAP made of the same photographs, in the world of
    their poses; says so. None where the model has none, or its cameras do not stand as the photographs' do.

    Args:
        model: a folder of COLMAP's files.
        shots: the photographs, whose poses may be in another world than the model's.
        applied: a matrix [3,4] or [4,4] from the model's world to the poses', which counts where fewer than two
            photographs are in both; None: the worlds are the same.
    """
    try:
        found = read_model(model)
    except InputError as error:
        assume(f"points of the model beside the photographs are not used: {error}")
        return no_points()
    if not len(found.points):
        return no_points()
    whole = {PurePosixPath(image.name).with_suffix(""): image.world_to_camera for image in found.images}
    last = {stem.name: pose for stem, pose in whole.items()}
    pairs = []
    for shot in shots:
        stem = PurePosixPath(shot.name).with_suffix("")
        pose = whole.get(stem, last.get(stem.name) if len(last) == len(whole) else None)
        if pose is not None:
            pairs.append((pose, shot.world_to_camera))
    matrix = _similarity(*map(np.stack, zip(*pairs))) if len(pairs) >= 2 else _applied(applied)
    if matrix is None:
        assume(f"the points of the model {model} are not used: its cameras do not stand as those of the photographs do")
        return no_points()
    assume(
        f"the {len(found.points)} points are those of the model {model}, in the world of the poses by "
        f"{f'{len(pairs)} cameras that both have' if len(pairs) >= 2 else 'applied_transform'}"
    )
    return found.points @ matrix[:, :3].T + matrix[:, 3], found.colours


def _similarity(theirs: np.ndarray, ours: np.ndarray) -> np.ndarray | None:
    """The matrix [3,4], a rotation with a scale and a shift, of one world to another in which the same cameras
    [C,4,4], world to camera, are known; None where there is none."""
    turns = ours[:, :3, :3].swapaxes(1, 2) @ theirs[:, :3, :3]
    turn = nearest_rotation(turns.sum(0))
    before, after = (-(pose[:, :3, :3].swapaxes(1, 2) @ pose[:, :3, 3:])[..., 0] for pose in (theirs, ours))
    moved = (before - before.mean(0)) @ turn.T
    spread = after - after.mean(0)
    size = float((moved**2).sum())
    scale = float((moved * spread).sum()) / size if size > 0 else 0.0
    off = np.abs(scale * moved - spread).max()
    if not scale > 0 or off > _CAMERAS_OFF * np.abs(spread).max() or np.abs(turns - turn).max() > _CAMERAS_OFF:
        return None
    return np.column_stack([scale * turn, after.mean(0) - scale * turn @ before.mean(0)])


def _applied(matrix: Any) -> np.ndarray | None:
    """A matrix [3,4] of a file; None where it is none."""
    if matrix is None:
        return np.eye(3, 4)
    try:
        numbers = np.array(matrix, np.float64)
    except (ValueError, TypeError):
        return None
    return numbers[:3] if numbers.shape in ((3, 4), (4, 4)) and np.isfinite(numbers).all() else None


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [P,3] float64 and colours [P,3] uint8 of a .ply; of Gaussians their centres, and their colours as seen
    from all around. Grey, and said, where the file has no colours. Raises InputError."""
    with reading(path), path.open("rb") as file:
        header = read_header(path, file.read(HEADER_LIMIT_BYTES))
        vertices = read_elements(path, header).get("vertex")
    columns = () if vertices is None else vertices.dtype.names or ()
    if vertices is None or not {"x", "y", "z"} <= set(columns):
        raise InputError(f"{path}: expected points with x, y and z")
    points = np.stack([vertices[key].astype(np.float64) for key in "xyz"], 1)
    names = next((names for names in _COLOURS if set(names) & set(columns)), ())
    if not names and set(_HARMONICS) <= set(columns):
        return points, _of_harmonics(np.stack([vertices[key] for key in _HARMONICS], 1))
    colours = np.full(points.shape, 128, np.uint8)
    if not names and len(points):
        assume(f"{path}: the points have no colours (red, green, blue) and are grey")
    for column, key in enumerate(names):
        if key in columns:
            values = vertices[key]
            full = {"uint8": 1, "uint16": 255 / 65535}.get(values.dtype.name, 255 if values.dtype.kind == "f" else 1)
            colours[:, column] = np.rint(np.nan_to_num(np.clip(values * full, 0, 255)))
    return points, colours


def _of_harmonics(coefficients: np.ndarray) -> np.ndarray:
    """Colours uint8 of harmonics of degree 0 [P,3]."""
    from lightfield_gs.base.harmonics import SH_CONSTANT  # whose module takes torch's time to import

    return np.rint(255 * np.nan_to_num(np.clip(0.5 + SH_CONSTANT * coefficients, 0, 1))).astype(np.uint8)
