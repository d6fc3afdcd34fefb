"""Options of the cameras and of how the scene is to look on the panel."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.commands.options.parser import camera_choice, numbers, within
from lightfield_gs.scene.axes import UP_AXES

if TYPE_CHECKING:
    pass


def add_camera(add: Callable[..., argparse.Action]) -> None:
    """Add the options of the cameras of the views."""
    add(
        "--rig",
        type=Path,
        metavar="YAML",
        help="cameras of the views, in the file's own axes (default: the cameras stored in the file, else "
        "automatic framing)",
    )
    add(
        "--camera",
        type=camera_choice,
        metavar="FILE[:INDEX]",
        help="centre camera of the views, in the file's own axes, from a cameras.json (3D Gaussian splatting), "
        "a transforms.json (NeRF) or a rig; its picture is fitted to the panel (default index 0)",
    )
    add_up(add)


def add_up(add: Callable[..., argparse.Action]) -> None:
    add(
        "--up",
        choices=UP_AXES,
        metavar="AXIS",
        help="axis that points up in the file, x, y, z, -x, -y or -z, for automatic framing; the Gaussians stay "
        "as they are (default: as stored in the file, else -y)",
    )


def add_look(add: Callable[..., argparse.Action]) -> None:
    """Add the options of focus, amount of depth, cone, zoom and pan."""
    add(
        "--focus",
        type=_focus,
        metavar="DEPTH|X,Y",
        help="depth of the panel's plane before the camera, in scene units; or a point of the picture whose "
        "surface lies in the plane: X of its width from the left, Y of its height from the top, 0..1 each "
        "(default: the rig's, else automatic)",
    )
    add(
        "--depth-amount",
        type=within(0, 2),
        metavar="FACTOR",
        help="factor of all disparities, 0 (flat) to 2 (default 1)",
    )
    add(
        "--cone",
        type=within(0, 179, "degrees"),
        metavar="DEG",
        help="full angle that the cameras of the views span, in degrees, 0..179 (default: the rig's or the panel's)",
    )
    add(
        "--zoom",
        type=within(0.01, 100),
        metavar="FACTOR",
        help="factor of the picture's size, about its middle (default 1)",
    )
    add(
        "--pan",
        type=_pan,
        metavar="X,Y",
        help="move the picture to the right by X of the panel's width and down by Y of its height (default 0,0)",
    )


def add_depth_report(add: Callable[..., argparse.Action]) -> None:
    add(
        "--depth-report",
        action="store_true",
        help="print the depth of the scene on the panel, in px and mm: disparities, depths before and behind "
        "the panel, comfort, the range of sharp depths, and the gaps that the outermost views show",
    )


def _focus(text: str) -> float | tuple[float, ...]:
    """Parse "2.5" to 2.5, a depth; "0.5,0.4" to (0.5, 0.4), a point of the picture."""
    if "," not in text:
        depth = numbers(1)(text)[0]
        if not 1e-6 <= depth <= 1e12:
            raise argparse.ArgumentTypeError(f"expected a depth of 1e-06..1e+12 scene units, got '{text}'")
        return depth
    point = numbers(2)(text)
    if not all(0 <= part <= 1 for part in point):
        raise argparse.ArgumentTypeError(f"expected a point X,Y of the picture, 0..1 each, got '{text}'")
    return point


def _pan(text: str) -> tuple[float, ...]:
    """Parse "-0.1,0.2" to (-0.1, 0.2)."""
    pan = numbers(2)(text)
    if not all(math.fabs(part) <= 10 for part in pan):
        raise argparse.ArgumentTypeError(f"expected fractions of the panel's width and height, -10..10, got '{text}'")
    return pan
