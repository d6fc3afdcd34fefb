"""The distance of a set's cameras from their object, and the distance that the network expects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.io.captures.objects import ObjectImages, object_depths

OBJECT_DISTANCE = 1.3
_NEAREST, _FARTHEST = 0.75, 1.33  # times that, of cameras that are not scaled: further off the network has no depths


def at_object_distance(path: Path, views: ObjectImages) -> ObjectImages:
    """The same views, their poses scaled about the origin so that the mean depth of the point looked at is
    OBJECT_DISTANCE: the unit of length of a transforms file is arbitrary.

    Raises InputError, which names the file, where that depth is unknown.
    """
    poses = views.camera_to_world
    directions = poses[:, :3, 2]
    spread, distance = np.linalg.norm(directions - directions.mean(0), axis=-1).max(), object_depths(poses).mean()
    if spread < 1e-3 or distance <= 0:
        raise InputError(
            f"{path}: transform_matrix: the {len(poses)} cameras look in one direction, so that their "
            "distance from the object is unknown: expected views from several sides"
        )
    scaled = poses.copy()
    scaled[:, :3, 3] *= OBJECT_DISTANCE / distance
    return replace(views, camera_to_world=scaled)


def distance_doubt(camera_to_world: np.ndarray) -> str | None:
    """Return the remedy for cameras [V,4,4] at another distance than the network expects, as in some SRN data."""
    if len(camera_to_world) < 2:
        return None
    distance = object_depths(camera_to_world).mean()
    if _NEAREST < distance / OBJECT_DISTANCE < _FARTHEST:
        return None
    return (
        f"the cameras stand {distance:.2f} units from what they look at, the network expects it at "
        f"{OBJECT_DISTANCE}: multiply the positions in the poses by {OBJECT_DISTANCE / distance:.3g}"
    )
