"""Points of a capture in .ply files: point clouds, and scenes of Gaussians that were fitted before."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.errors import InputError, reading
from lightfield_gs.io.ply_file import HEADER_LIMIT_BYTES, read_elements, read_header

_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_HARMONICS = ("f_dc_0", "f_dc_1", "f_dc_2")  # of a scene of Gaussians
# Names in lower case, from nerfstudio, COLMAP, 3D Gaussian splatting and apps
_NAMES = ("sparse_pc.ply", "points3d.ply", "point_cloud.ply", "pointcloud.ply", "input.ply")


def no_points() -> tuple[np.ndarray, np.ndarray]:
    """Return no points: [0,3] float64, and colours [0,3] uint8."""
    return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def find_points(model: Path | None, folders: Sequence[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Find a .ply that no layout names, and read its points, in the world of the poses, with a note.

    Args:
        model: a folder of COLMAP's files; a single .ply there may have any name.
        folders: where a .ply of a usual name is taken.

    Returns:
        Points [P,3] float64 and colours [P,3] uint8.
    """
    candidates = [*([] if model is None else [model]), *folders]
    for folder in dict.fromkeys(candidates):
        with reading(folder):
            files = sorted(path for path in folder.iterdir() if path.suffix.lower() == ".ply" and path.is_file())
        usual = [path for name in _NAMES for path in files if path.name.lower() == name]
        found = usual or (files if folder == model and len(files) == 1 else [])
        if found:
            try:
                points, colours = read_points(found[0])
            except InputError as error:
                assume(f"points beside the photographs are not used: {error}")
                continue
            assume(f"the {len(points)} points of {found[0]} are those of the scene: nothing else says where it is")
            return points, colours
    return no_points()


def read_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the points of a .ply; of Gaussians their centres, and their colours averaged over all directions.

    Returns:
        Points [P,3] float64 and colours [P,3] uint8. Where the file has no colours they are grey, with a note.

    Raises:
        InputError: names the file.
    """
    with reading(path), path.open("rb") as file:
        header = read_header(path, file.read(HEADER_LIMIT_BYTES))
        vertices = read_elements(path, header).get("vertex")
    columns = () if vertices is None else vertices.dtype.names or ()
    if vertices is None or not {"x", "y", "z"} <= set(columns):
        raise InputError(f"{path}: expected points with x, y and z")
    points = np.stack([vertices[key].astype(np.float64) for key in "xyz"], 1)
    names = next((names for names in _COLOURS if set(names) & set(columns)), ())
    if not names and set(_HARMONICS) <= set(columns):
        return points, _harmonics_colours(np.stack([vertices[key] for key in _HARMONICS], 1))
    colours = np.full(points.shape, 128, np.uint8)
    if not names and len(points):
        assume(f"{path}: the points have no colours (red, green, blue) and are grey")
    for column, key in enumerate(names):
        if key in columns:
            values = vertices[key]
            full = {"uint8": 1, "uint16": 255 / 65535}.get(values.dtype.name, 255 if values.dtype.kind == "f" else 1)
            colours[:, column] = np.rint(np.nan_to_num(np.clip(values * full, 0, 255)))
    return points, colours


def _harmonics_colours(coefficients: np.ndarray) -> np.ndarray:
    """Return the colours uint8 of harmonics of degree 0 [P,3]."""
    from lightfield_gs.base.harmonics import SH_CONSTANT  # imports torch, which is slow

    return np.rint(255 * np.nan_to_num(np.clip(0.5 + SH_CONSTANT * coefficients, 0, 1))).astype(np.uint8)
