"""The cameras that a trainer of Gaussians leaves beside its scene: the scene opens from the one in their middle."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.camera_files import FileCamera, read_inria
from lightfield_gs.io.captures.central import axes_intersection, directions_from, most_central
from lightfield_gs.io.scenes.files import is_scene_path

_NAME = "cameras.json"  # of Kerbl et al.'s trainer and those after it, in the coordinates of the scene


def trainer_cameras(scene: Path) -> Path | None:
    """Return the file of the cameras of a scene's photographs; None where there is none.

    It lies in the trainer's folder, above point_cloud/iteration_N; or beside a scene that is alone in its folder.
    """
    folder = scene if scene.is_dir() else scene.parent
    inside = folder.resolve()
    if re.fullmatch(r"iteration_\d{1,9}", inside.name):
        inside = inside.parent
    if inside.name == "point_cloud":
        inside = inside.parent
    elif not scene.is_dir() and sum(is_scene_path(path) for path in folder.glob("*.*")) != 1:
        return None
    found = inside / _NAME
    return found if found.is_file() else None


def central_camera(path: Path, cone_deg: float) -> tuple[FileCamera, int] | None:
    """Return the camera that most others are near, within half a panel's cone, and its index.

    Args:
        path: the file of the cameras.
        cone_deg: full angle of the panel's cone.

    Returns:
        None for a file that holds no such cameras.
    """
    try:
        cameras = read_inria(path)
    except InputError:
        return None
    poses = np.stack([camera.world_to_camera for camera in cameras])
    rotations = poses[:, :3, :3]
    centres = -(rotations.swapaxes(1, 2) @ poses[:, :3, 3:])[..., 0]
    middle = axes_intersection(centres, rotations[:, 2])
    if middle is None:  # they look different ways, as in a room
        index = int(np.linalg.norm(centres - np.median(centres, 0), axis=1).argmin())
    else:
        index, _ = most_central(directions_from(centres, middle), cone_deg / 2)
    return cameras[index], index
