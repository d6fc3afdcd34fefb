"""Write COLMAP models as text, without observations. Source: COLMAP's documentation, "Output Format"."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np


def write_text_model(
    folder: Path,
    cameras: Iterable[str],
    photographs: Sequence[tuple[str, np.ndarray, int]],
    points: np.ndarray,
    colours: np.ndarray,
) -> None:
    """Write cameras.txt, images.txt and points3D.txt.

    Args:
        folder: where they go.
        cameras: lines of the file: number, model, width, height, parameters.
        photographs: name, world_to_camera [4,4] and the number of the camera of each.
        points: [P,3].
        colours: [P,3] uint8.
    """
    poses = []
    for number, (name, pose, camera) in enumerate(photographs, 1):
        place = joined_numbers([*to_quaternion(pose[:3, :3]), *pose[:3, 3]], 9)
        poses.append(f"{number} {place} {camera} {name}\n")  # and a line for its observations
    lines = [
        f"{number} {joined_numbers(point, 6)} {' '.join(map(str, colour))} 0"
        for number, (point, colour) in enumerate(zip(points, colours), 1)
    ]
    (folder / "cameras.txt").write_text("\n".join(["# number, model, width, height, parameters", *cameras, ""]))
    (folder / "images.txt").write_text("\n".join(["# number, qw qx qy qz, tx ty tz, camera, name", *poses, ""]))
    (folder / "points3D.txt").write_text("\n".join(["# number, x y z, r g b, error (not kept)", *lines, ""]))


def joined_numbers(values: Iterable[float], digits: int) -> str:
    """Return numbers with so many digits, and spaces between."""
    return " ".join(f"{value:.{digits}g}" for value in values)


def to_quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion [4] of a rotation [3,3], w, x, y, z with w >= 0.

    It is the eigenvector of the largest eigenvalue of a symmetric matrix of the rotation's entries. Source:
    Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix", 2000.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    quaternion = np.linalg.eigh(matrix)[1][:, 3]
    return quaternion if quaternion[0] >= 0 else -quaternion
