"""Cameras of the views (JSON) and the views of the sub-pixels (NPY), for the method `sorted`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from lightfield_gs.base.errors import InputError, named
from lightfield_gs.encoding.sorted_plan import checked_view_map
from lightfield_gs.io.captures.camera_files import is_camera_file
from lightfield_gs.io.npy import open_array
from lightfield_gs.io.text_files import check_keys, read_json
from lightfield_gs.panels.panel import MAX_VIEWS, Panel
from lightfield_gs.scene.cameras import Cameras

_LIMIT_BYTES = 64 << 20
_FIELDS = {"world_to_camera": (4, 4), "focal_px": (2,), "principal_point_px": (2,)}


def read_cameras(path: str | Path, panel: Panel) -> Cameras:
    """Read one camera for each view, float64. Raises InputError that names the file and the field.

    The file has world_to_camera [N, 4, 4] (OpenCV axes), and focal_px [N, 2] and principal_point_px [N, 2] at the
    panel's resolution.
    """
    data = read_json(path, _LIMIT_BYTES)
    if is_camera_file(data):
        raise InputError(
            f"{path}: holds the cameras of photographs (cameras.json or transforms.json), not one for "
            "each view of the panel; give it as camera=FILE[:INDEX] for the centre camera"
        )
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected an object with {', '.join(_FIELDS)}, got {type(data).__name__}")
    check_keys(data, _FIELDS, (), str(path))
    arrays = {name: _numbers(f"{path}: {name}", data[name], shape) for name, shape in _FIELDS.items()}
    counts = {name: len(array) for name, array in arrays.items()}
    if len(set(counts.values())) > 1 or not 1 <= counts["focal_px"] <= MAX_VIEWS:
        raise InputError(
            f"{path}: expected the same number of cameras in every field, 1..{MAX_VIEWS}, got "
            + ", ".join(f"{name} {count}" for name, count in counts.items())
        )
    _check_poses(f"{path}: world_to_camera", arrays["world_to_camera"])
    with named(path):
        pose, focal, centre = (torch.from_numpy(array) for array in arrays.values())
        return Cameras(pose, focal, centre, panel.width_px, panel.height_px)


def read_view_map(path: str | Path, panel: Panel, views: int) -> np.ndarray:
    """Read which of `views` views each sub-pixel shows, int32 [H,W,3] by image channel, -1 for none; a NumPy .npy file.

    Raises InputError that names the file.
    """
    table = open_array(path)
    with named(path):
        return checked_view_map(table, panel, views)


def _numbers(what: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return `value` as float64 [N, *shape]. Raises InputError."""
    expected = f"expected numbers [N, {', '.join(map(str, shape))}]"
    try:
        array = np.array(value)
    except ValueError:
        raise InputError(f"{what}: {expected}, got rows of different lengths") from None
    if array.dtype.kind not in "iuf" or array.shape[1:] != shape or array.ndim != len(shape) + 1:
        raise InputError(f"{what}: {expected}, got {array.dtype} {list(array.shape)}")
    array = array.astype(np.float64)
    bad = ~np.isfinite(array).reshape(len(array), -1).all(1)
    if bad.any():
        raise InputError(f"{what}: expected finite numbers, got others in camera {int(bad.argmax())}")
    return array


def _check_poses(what: str, poses: np.ndarray) -> None:
    """Raise InputError for the first matrix that is not a rotation and a translation over 0 0 0 1."""
    rotations = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max((1, 2))
        good = (error < 1e-4) & (np.linalg.det(rotations) > 0) & (poses[:, 3] == (0, 0, 0, 1)).all(1)
    if not good.all():
        raise InputError(
            f"{what}: expected a rotation (orthonormal, determinant +1) and a translation over 0 0 0 1, "
            f"got something else in camera {int((~good).argmax())}; scale, shear and mirroring are not "
            "allowed"
        )
