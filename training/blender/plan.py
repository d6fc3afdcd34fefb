"""Cameras for a set of views of one's own meshes: `python -m training.blender.plan --panel 65in-8k-96v -o cone.json`.

The cameras stand at the views of the panel's rig, on a line through the centre camera, within --cone-margin times the
panel's cone. Each is turned to the object, in the middle of the zero plane. The rig's own cameras stay parallel and
shift their images instead, so they see the same rays on another image plane. Further rows are the same fan from a
raised and a lowered centre camera; further directions the same from other sides.

The plan is a transforms.json without images; io/captures/transforms.py describes the layout. The world has z up, and
the object about the origin, with a bounding box whose diagonal is 1. Blender renders each object into its own folder.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.io.captures.pinhole import TO_OPENCV
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from training.command import with_line_errors
from training.data.distance import OBJECT_DISTANCE

FOCAL = 1.025  # of the image's side: the unit-diagonal object fits from OBJECT_DISTANCE, whichever way it is turned


def look_at(position: np.ndarray) -> np.ndarray:
    """Camera-to-world matrix [4,4] of an upright camera that looks at the origin; world z is up, OpenCV axes."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, position], axis=1)
    return pose


def fan(
    panel: Panel, distance: float, cone_deg: float, direction_deg: float, elevation_deg: float, columns: int
) -> np.ndarray:
    """Return camera-to-world matrices [columns,4,4] (OpenCV axes) at views of the panel's rig, turned to the origin.

    The fan spans cone_deg evenly in angle, with its centre first if columns is odd: one column is the centre alone.

    Args:
        distance: of the centre camera from the origin, to which it looks.
        direction_deg: of the centre camera round the z axis, from the -y axis.
        elevation_deg: of the centre camera above the xy plane.
    """
    direction, elevation = math.radians(direction_deg), math.radians(elevation_deg)
    centre = distance * np.array(
        [math.sin(direction) * math.cos(elevation), -math.cos(direction) * math.cos(elevation), math.sin(elevation)]
    )
    rig = Rig(np.linalg.inv(look_at(centre)), (1.0, 1.0), (0.0, 0.0), distance, cone_deg)
    angles = np.radians(cone_deg / max(columns - 1, 1) * (np.arange(columns) - (columns - 1) / 2))
    angles = angles[np.argsort(np.abs(angles), kind="stable")]
    places = panel.views / 2 * (1 + np.tan(angles) / math.tan(math.radians(cone_deg) / 2))
    world_to_camera = rig.cameras_at(panel, places).world_to_camera.numpy()
    return np.stack([look_at(pose[:3, 3]) for pose in np.linalg.inv(world_to_camera)])


def make_plan(
    panel: Panel,
    rig: Rig | None = None,
    *,
    cone_margin: float = 1.0,
    columns: int = 9,
    rows: int = 3,
    row_step_deg: float = 6.0,
    elevation_deg: float = 15.0,
    directions: int = 1,
    size_px: int = 256,
    focal: float = FOCAL,
) -> dict[str, Any]:
    """Return the plan as JSON-like values; the first frame is the centre camera of the first direction.

    Args:
        rig: Its cone_deg and zero_depth (in diagonals of the object) replace the panel's cone and OBJECT_DISTANCE.
        columns, rows: Cameras along the fan, and fans above each other, row_step_deg apart, about elevation_deg.
        focal: Focal length in units of size_px.

    Raises:
        InputError: the numbers make no views, or the object would be cut.
    """
    distance = OBJECT_DISTANCE if rig is None else rig.zero_depth
    cone_deg = cone_margin * (panel.cone_deg if rig is None or rig.cone_deg is None else rig.cone_deg)
    highest = abs(elevation_deg) + rows // 2 * row_step_deg
    _check(0 < cone_deg <= 170, "cone-margin", "a cone of 0 to 170 degrees", f"{cone_deg:g}")
    _check(
        min(columns, rows, directions) >= 1 and columns * rows * directions <= 10_000,
        "columns, rows, directions",
        "1 to 10,000 cameras",
        f"{columns} x {rows} x {directions}",
    )
    _check(highest <= 85, "elevation", "rows within +-85 degrees", f"{highest:g}")
    _check(8 <= size_px <= 8192, "size", "8 to 8192 pixels", str(size_px))
    # The sphere round the unit diagonal must fit before the nearest camera.
    largest = math.sqrt(distance**2 - 0.25) if distance > 0.5 else 0.0
    _check(
        0 < focal <= largest,
        "focal",
        f"more than 0, and at most {largest:.4g} at distance {distance:g}, for the whole object to be seen",
        f"{focal:g}",
    )
    # Rows in the order 0, +1, -1, +2, ... about the middle one.
    elevations = [elevation_deg + row_step_deg * (-1) ** (row + 1) * ((row + 1) // 2) for row in range(rows)]
    poses = [
        pose
        for turn in range(directions)
        for elevation in elevations
        for pose in fan(panel, distance, cone_deg, 360 / directions * turn, elevation, columns)
    ]
    return {
        "w": size_px,
        "h": size_px,
        "fl_x": focal * size_px,
        "frames": [
            {"file_path": f"images/{index:06d}.png", "transform_matrix": (pose @ TO_OPENCV).tolist()}
            for index, pose in enumerate(poses)
        ],
    }


def _check(good: bool, option: str, expected: str, found: str) -> None:
    if not good:
        raise InputError(f"{option}: expected {expected}, got {found}")


@with_line_errors("training.blender.plan")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.blender.plan",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--panel", default=DEFAULT_PANEL, help=f"name or file (default: {DEFAULT_PANEL})")
    parser.add_argument("--device-serial", help="which display, where a Looking Glass .json has several")
    parser.add_argument("--rig", type=Path, help="YAML: its cone_deg, and zero_depth in diagonals of the object")
    parser.add_argument("-o", "--output", type=Path, required=True, help="JSON file to write")
    for option, default, text in (
        ("cone-margin", 1.0, "times the cone; for training 1.5"),
        ("row-step", 6.0, "degrees between rows"),
        ("elevation", 15.0, "of the middle row, degrees"),
        ("focal", FOCAL, "focal length in units of the image's side"),
    ):
        parser.add_argument(f"--{option}", type=float, default=default, help=f"{text} (default: {default:g})")
    for option, default, text in (
        ("columns", 9, "cameras along the fan"),
        ("rows", 3, "fans above each other"),
        ("directions", 1, "sides of the object"),
        ("size", 256, "of the images, pixels"),
    ):
        parser.add_argument(f"--{option}", type=int, default=default, help=f"{text} (default: {default})")
    options = parser.parse_args(arguments)
    plan = make_plan(
        Panel.load(options.panel, serial=options.device_serial),
        None if options.rig is None else Rig.from_yaml(options.rig),
        cone_margin=options.cone_margin,
        columns=options.columns,
        rows=options.rows,
        row_step_deg=options.row_step,
        elevation_deg=options.elevation,
        directions=options.directions,
        size_px=options.size,
        focal=options.focal,
    )
    with atomic_path(options.output) as temporary:
        temporary.write_text(json.dumps(plan, indent=1) + "\n")
    print(f"{options.output}: {len(plan['frames'])} cameras")
    return 0


if __name__ == "__main__":
    sys.exit(main())
