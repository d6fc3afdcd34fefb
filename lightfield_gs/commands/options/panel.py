"""Options of the panel, of the cameras of its views, of the look of the scene, and of the rendering of the image."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from lightfield_gs.base.options import COMPRESSIONS, DEFAULT_PANEL, DEVICES, METHODS, QUALITY_NAMES, UP_AXES, VIEWS
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import Add, in_group
from lightfield_gs.commands.options.parser import (
    background_or_auto,
    byte_size,
    camera_choice,
    drawing_device,
    numbers,
    panel_name,
    threads,
    within,
)
from lightfield_gs.commands.options.scene import add_scene
from lightfield_gs.panels.display_kinds import DISPLAY_KINDS

_distance_mm = within(1e-3, 1e9, "mm")
_depth_amount = within(0, 2)
_cone_deg = within(0, 179, "degrees")
_turn_deg = within(-180, 180, "degrees")
_tilt_deg = within(-89, 89, "degrees")
_zoom = within(0.01, 100)
_filter_views = within(0, 65536, "views")


def add_encoding(add: Add) -> None:
    """Add the options of encoding one input, alone or in a batch."""
    add_panel(add, "for --preview, for framing, and for `simulate` afterwards")
    add_camera(add)
    add_look(add)
    add_depth_report(add)
    add_views(add)
    add_scene(
        add, "cut the object out of a photo with rembg (pip install 'lightfield-gs[photo]'; it downloads 176 MB once)"
    )
    add_method(add)
    add_rendering(add)
    add_file(add)


def add_panel(add: Add, purpose: str) -> None:
    """Add the options of the panel and of its viewing distance.

    Args:
        purpose: The use of the distance, for the help.
    """
    add = in_group(add, groups.DISPLAY)
    add(
        "--panel",
        type=panel_name,
        metavar="PANEL",
        short="visual.json of the display, or its name (27, go)",
        help="a Looking Glass visual.json, a .yaml, the name of a profile, or of a Looking Glass display "
        f"({', '.join(DISPLAY_KINDS)}) (default: the display that is connected, else {DEFAULT_PANEL})",
    )
    add_device_serial(add)
    add_viewing_distance(add, f"distance of the viewer from the panel, in place of the panel's own: {purpose}")


def add_device_serial(add: Add) -> None:
    add = in_group(add, groups.DISPLAY)
    add(
        "--device-serial",
        metavar="SERIAL",
        help="serial number of the display, if a Looking Glass .json has several calibrations",
    )


def add_changed_profile(add: Add) -> None:
    """Add the profile that a command changes, its new file, and which calibration of it is meant."""
    add(
        "profile",
        type=panel_name,
        metavar="PROFILE",
        short="visual.json, .yaml or a name",
        help="name, .yaml or Looking Glass visual.json",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="NEW",
        short="the changed calibration, perhaps the same file",
        help="the changed profile, in the format of PROFILE; it may be the same file",
    )
    add_device_serial(add)


def add_viewing_distance(add: Add, help: str) -> None:
    in_group(add, groups.DISPLAY)("--viewing-distance", type=_distance_mm, metavar="MM", help=help)


def add_camera(add: Add) -> None:
    """Add the options of the cameras of the views."""
    add = in_group(add, groups.VIEWPOINT)
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
    add_turn(add)


def add_turn(add: Add) -> None:
    """Add the options of the direction from which a scene is seen."""
    add = in_group(add, groups.VIEWPOINT)
    add(
        "--turn",
        type=_turn_deg,
        metavar="DEG",
        short="go so many degrees round the scene, to the right",
        help="see a scene from another side: the cameras go so many degrees to the right round it, -180..180 (default: "
        "the side that shows most of a scene without cameras; 0: as its file has it)",
    )
    add(
        "--tilt",
        type=_tilt_deg,
        metavar="DEG",
        short="go so many degrees up",
        help="see a scene from above: the cameras go so many degrees up round it, -89..89",
    )


def add_up(add: Add) -> None:
    add = in_group(add, groups.VIEWPOINT)
    add(
        "--up",
        choices=UP_AXES,
        metavar="AXIS",
        short="axis that points up, as z where a scene lies",
        help="axis that points up in the file, x, y, z, -x, -y or -z, for automatic framing; the Gaussians stay "
        "as they are (default: as stored in the file, else -y)",
    )


def add_look(add: Add) -> None:
    """Add the options of focus, amount of depth, cone, zoom and pan."""
    add = in_group(add, groups.LOOK)
    add(
        "--focus",
        type=_focus,
        metavar="DEPTH|X,Y",
        short="point of the picture that lies in the screen: 0.5,0.4",
        help="depth of the panel's plane before the camera, in scene units; or a point of the picture whose "
        "surface lies in the plane: X of its width from the left, Y of its height from the top, 0..1 each "
        "(default: the rig's, else automatic)",
    )
    add(
        "--depth-amount",
        type=_depth_amount,
        metavar="FACTOR",
        short="0 (flat) to 2 (twice as deep)",
        help="factor of all disparities, 0 (flat) to 2 (default 1)",
    )
    add(
        "--cone",
        type=_cone_deg,
        metavar="DEG",
        help="full angle that the cameras of the views span, in degrees, 0..179 (default: the rig's or the panel's)",
    )
    add(
        "--zoom",
        type=_zoom,
        metavar="FACTOR",
        short="size of the picture (default 1)",
        help="factor of the picture's size, about its middle (default 1)",
    )
    add(
        "--pan",
        type=_pan,
        metavar="X,Y",
        help="move the picture to the right by X of the panel's width and down by Y of its height (default 0,0)",
    )


def add_depth_report(add: Add) -> None:
    add = in_group(add, groups.LOOK)
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


def add_device(add: Add) -> None:
    """Add the option of the device."""
    add = in_group(add, groups.DRAWING)
    add(
        "--device",
        choices=DEVICES,
        default="auto",
        help="device of network and rasterizer (default auto: cuda if there is a GPU and this build can use it)",
    )


def add_drawing_device(add: Add) -> None:
    """Add the option of the device for commands that WebGPU can draw for."""
    add = in_group(add, groups.DRAWING)
    add(
        "--device",
        type=drawing_device,
        default="auto",
        metavar="{auto,cpu,cuda,webgpu[:N]}",
        short="cpu, cuda, or webgpu: a graphics card of any maker",
        help="device of network and rasterizer; webgpu draws on a GPU of any maker, N of `info --devices`, and the "
        "network stays on the CPU (default auto: cuda if there is a GPU and this build can use it)",
    )


def add_views(add: Add) -> None:
    """Add the options of cameras and a view map, in place of a rig and a lens."""
    add = in_group(add, groups.VIEWPOINT)
    add(
        "--cameras",
        type=Path,
        metavar="JSON",
        help="for --method sorted, in place of a rig: one camera for each view, the right-most eye's first, "
        "with world_to_camera [N,4,4] (OpenCV axes, scene units), focal_px [N,2] and principal_point_px "
        "[N,2] (pixels of the panel)",
    )
    add(
        "--view-map",
        type=Path,
        metavar="NPY",
        help="for --method sorted, in place of the panel's lens: the view of each sub-pixel, int32 [H,W,3], "
        "0..N-1, or -1 for the background",
    )


def add_method(add: Add) -> None:
    """Add the options of how the image is computed."""
    add = in_group(add, groups.DRAWING)
    add(
        "--method",
        choices=METHODS,
        default="direct",
        help="direct: all sub-pixels in one pass; sorted: view by view, for any --cameras and --view-map; "
        "classic: one image per view, then interlaced (slow; for comparison); default direct",
    )
    add(
        "--memory-budget",
        type=byte_size,
        metavar="SIZE",
        help="work memory of --method sorted in addition to the image, for example 256MB (B, KB, MB, GB, KiB, "
        "MiB, GiB). Default: 256MiB, or 1GiB on cuda, plus the sorted sub-pixels, 0.2GB on an 8K panel",
    )
    add(
        "--views",
        choices=VIEWS,
        default="integer",
        help="integer: N views; continuous: a viewpoint of its own for every sub-pixel (default integer)",
    )
    add(
        "--quality",
        choices=QUALITY_NAMES,
        default="exact",
        help="of --method direct: less time for more error (default exact)",
    )


def add_filters(add: Add) -> None:
    """Add the options of anti-aliasing, of pixels and of views."""
    add = in_group(add, groups.DRAWING)
    add(
        "--antialiased",
        action=argparse.BooleanOptionalAction,
        help="for scenes trained with anti-aliasing (Mip-Splatting, gsplat's antialiased mode), which look too "
        "bright and too thick without it: Gaussians that the pixel blur widens become fainter (default: as "
        "stored in the file, else without)",
    )
    add(
        "--view-filter",
        type=_filter_views,
        default=0.0,
        metavar="VIEWS",
        help="anti-aliasing between views, with a rig: each sub-pixel's picture is averaged over camera "
        "positions this many views wide. Things far before or behind the panel are then blurred, not seen "
        "double; 0: off, 1: the width of a view (default 0)",
    )


def add_rendering(add: Add) -> None:
    """Add the options of how a scene is drawn: anti-aliasing and background."""
    add = in_group(add, groups.DRAWING)
    add_filters(add)
    add(
        "--background",
        type=background_or_auto,
        metavar="COLOUR",
        short="white, #rrggbb, or R,G,B in 0..1",
        help="R,G,B in 0..1, a name as white, black or grey, #rrggbb, or auto (default). auto: for a photo of one "
        "object white or a dark grey, whichever its outline stands out from; for a scene the background that "
        "lightfield-gs fitted it before, if the file states it, else white",
    )


def add_file(add: Add) -> None:
    """Add the options of how the image is stored."""
    add = in_group(add, groups.STORAGE)
    add(
        "--bit-depth",
        type=int,
        choices=(8, 16, 32),
        metavar="BITS",
        help="8, 16 or 32 (float: .exr, .tif); default 8, for .exr 32",
    )
    add(
        "--compression",
        choices=COMPRESSIONS,
        default="fast",
        help="fast: quick to write; small: a small file (default fast)",
    )
    add("--threads", type=threads, metavar="N", help="number of threads (default: all cores)")
