"""nerfstudio's dataparser_transforms.json: from the world of a transforms.json to that of its trained models.

Source: nerfstudio, DataparserOutputs.save_dataparser_transform. A point p of the poses' world is at scale * (R p + t)
in the model's, where [R t] is the 3 x 4 matrix `transform`. A scene that nerfstudio exports stands there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lightfield_gs.base.assumptions import assume
from lightfield_gs.base.checks import real_number, shown
from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.pinhole import check_pose, nearest_rotation
from lightfield_gs.io.text_files import read_object

_NAME = "dataparser_transforms.json"
_LIMIT_BYTES = 1 << 20


@dataclass(frozen=True)
class Similarity:
    """A motion and a scale of a world: p to scale * (rotation p + translation).

    Attributes:
        rotation: [3,3] float64.
        translation: [3] float64.
        scale: > 0.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float

    def points(self, points: np.ndarray) -> np.ndarray:
        """Move points [P,3]."""
        return self.scale * (points @ self.rotation.T + self.translation)

    def pose(self, world_to_camera: np.ndarray) -> np.ndarray:
        """Return world to camera [4,4] in the moved world."""
        moved = np.eye(4)
        moved[:3, :3] = world_to_camera[:3, :3] @ self.rotation.T
        centre = -world_to_camera[:3, :3].T @ world_to_camera[:3, 3]
        moved[:3, 3] = -moved[:3, :3] @ self.points(centre)
        return moved

    def readout(self, readout: np.ndarray | None) -> np.ndarray | None:
        """Return the turn and the way of a camera [2,3], in its own axes, in the moved world."""
        return None if readout is None else readout * [[1.0], [self.scale]]


def find_dataparser_transform(path: Path) -> Similarity | None:
    """Read the dataparser_transforms.json beside a transforms.json, with a note; None where there is none.

    Args:
        path: the transforms.json.

    Raises:
        InputError: names the field.
    """
    file = path.parent / _NAME
    if not file.is_file():
        return None
    found = read_dataparser_transform(file)
    assume(
        f"cameras and points of {path} are moved as {_NAME} says, scaled by {found.scale:.4g}, as nerfstudio's scenes "
        "are"
    )
    return found


def read_dataparser_transform(file: Path) -> Similarity:
    """Read a dataparser_transforms.json.

    Raises:
        InputError: names the field.
    """
    data = read_object(file, _LIMIT_BYTES)
    matrix = data.get("transform")
    try:
        numbers = np.array(matrix, np.float64)
    except (ValueError, TypeError):
        numbers = np.zeros(0)
    if numbers.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{file}: transform: expected 3 rows of 4 numbers, got {shown(matrix)}")
    pose = np.eye(4)
    pose[:3] = numbers[:3]
    check_pose(f"{file}: transform", pose)
    scale = real_number(f"{file}: scale", data.get("scale", 1.0), 1e-9, 1e9)
    return Similarity(nearest_rotation(pose[:3, :3]), pose[:3, 3], scale)
