"""The rig or the cameras of a command, and whether they look as if they were made for the panel."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.base.cli_messages import note
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.cameras import Cameras


def load_rig(args: argparse.Namespace, panel: Panel) -> Rig | None:
    """The rig of --rig, if there is one; says where it looks like one of another panel. Raises InputError."""
    from lightfield_gs.panels.rig import Rig

    if args.rig is None:
        return None
    rig = Rig.from_yaml(args.rig)
    _note_of_centre(args.rig, rig.principal_point_px, panel)
    return rig


def load_cameras(args: argparse.Namespace, panel: Panel) -> Cameras:
    """Those of --cameras; says where they look as if they were in the wrong order, or made for another panel."""
    from lightfield_gs.encoding.view_files import read_cameras

    cameras = read_cameras(args.cameras, panel)
    _note_of_centre(args.cameras, cameras.intrinsics()[:, 2:].median(0).values.tolist(), panel)
    if args.view_map is None:  # a view map has the views in an order of its own
        _note_of_order(args.cameras, cameras, panel)
    return cameras


def _note_of_centre(path: Path, principal_point_px: Sequence[float], panel: Panel) -> None:
    """Says where cameras' lengths look as if they counted pixels of another panel: then the principal point is off the
    middle in both directions alike. In one alone it is where the content is beside the axis and was centred."""
    size = panel.width_px, panel.height_px
    places = [centre / pixels for centre, pixels in zip(principal_point_px, size)]
    if max(places) < 0.3 or min(places) > 0.7:
        x, y = principal_point_px
        note(
            f"{path}: its principal point ({x:g}, {y:g}) is far from the middle of the panel's {size[0]} x {size[1]} "
            "pixels; if it was made for a panel of another size, scale focal_px and principal_point_px by the ratio"
        )


def _note_of_order(path: Path, cameras: Cameras, panel: Panel) -> None:
    """Says where the cameras go from left to right, as those of quilts do, and views from right to left, or the other
    way round."""
    rotations, moves = cameras.world_to_camera[:, :3, :3], cameras.world_to_camera[:, :3, 3:]
    centres = -(rotations.transpose(1, 2) @ moves)[..., 0]
    right = rotations[cameras.count // 2, 0]
    half = (cameras.count + 1) // 2
    way = centres[:half].mean(0) - centres[-half:].mean(0)  # from the last to the first
    to_right = float(way @ right) * (-1 if panel.invert_views else 1)
    if to_right < -0.1 * float(way.norm()):
        sides = ("left", "right") if panel.invert_views else ("right", "left")
        note(
            f"{path}: view 0 of panel {panel.name} goes to the {sides[0]}-most eye, and camera 0 stands on the "
            f"{sides[1]}: depth is inside out; write the cameras in the other order"
        )
