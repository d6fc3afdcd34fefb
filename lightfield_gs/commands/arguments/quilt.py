"""The arguments of `lightfield-gs quilt`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.options import COMPRESSIONS, DEFAULT_QUILT
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_messages
from lightfield_gs.commands.options.panel import (
    add_camera,
    add_depth_report,
    add_device_serial,
    add_drawing_device,
    add_look,
    add_rendering,
    add_viewing_distance,
)
from lightfield_gs.commands.options.parser import Parser, panel_name, whole_numbers, within
from lightfield_gs.commands.options.scene import add_scene
from lightfield_gs.panels.display_kinds import QUILT_NAMES


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs quilt`."""
    parser.description = (
        "Render a photo or a 3D scene as a quilt: many views in one picture, for Looking Glass programs."
    )
    parser.epilog = (
        "The left-most camera's view is at the bottom left; views go on to the right, then up. `weave` takes "
        "quilts too."
    )
    parser.text.examples = (
        ("quilt photo.jpg -o photo", "for the connected display"),
        ("quilt scene.ply -o scene --preset go", "for a Looking Glass Go"),
        ("quilt scene.ply -o views --sweep 23x1", "23 pictures in a folder"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "input",
        type=Path,
        metavar="INPUT",
        short="a photo, or a scene",
        help="a photo or a scene, as `encode` takes it",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="NAME",
        short="the quilt; its name is completed: NAME_qs8x6a1.78.png",
        help="the quilt, .png (default) or .tif; _qs<columns>x<rows>a<aspect> is appended to a name without it",
    )
    _add_layout(add)
    add_camera(add)
    add_look(add)
    add_depth_report(add)
    add("--save-rig", type=Path, metavar="YAML", help="write the rig of the quilt, at the pixels of a tile")
    add(
        "--save-rgbd",
        type=Path,
        metavar="NAME",
        help="also write the centre camera's picture beside its depth map (right half, bright is near), as "
        "NAME_rgbd.png",
    )
    add_scene(add, "cut the object out of a photo with rembg")
    add_rendering(add)
    add_drawing_device(add)
    add(
        "--compression",
        choices=COMPRESSIONS,
        default="fast",
        help="fast: quick to write; small: a small file (default fast)",
    )
    add_messages(add)


def _add_layout(add) -> None:
    add(
        "--preset",
        "--device-preset",
        choices=tuple(QUILT_NAMES),
        short="a Looking Glass, by its name or inches",
        help=f"tiles, size and aspect of a Looking Glass device, by its name or its inches (default: "
        f"the display that is connected, else {DEFAULT_QUILT})",
    )
    add(
        "--panel",
        type=panel_name,
        metavar="PANEL",
        help="in place of a preset: the views, aspect and cone of a panel, each view as large as the panel if "
        "the quilt then has at most 8192 pixels a side",
    )
    add_device_serial(add)
    add_viewing_distance(add, "viewing distance of --panel, in place of its own, for framing")
    add(
        "--tiles",
        type=whole_numbers(1, 65536, "x", 2),
        metavar="CxR",
        short="columns and rows of views, as 8x6",
        help="columns and rows of views, in place of the preset's",
    )
    add(
        "--sweep",
        type=whole_numbers(1, 1000, "x", 2),
        metavar="Nx1",
        short="N pictures in a folder, as 23x1, in place of a quilt",
        help="single views in place of a quilt, N from the left-most camera's on, each of a tile's size, in the folder "
        "NAME: view_000.png, ...; `weave` takes them too",
    )
    add(
        "--size",
        type=whole_numbers(1, 65536, "x", 2),
        metavar="WxH",
        short="of the whole quilt, in pixels",
        help="size of the whole quilt, pixels",
    )
    add(
        "--aspect",
        type=within(0.01, 100),
        metavar="A",
        short="width by height of a view",
        help="width by height of a view as it is seen; its tile may have another aspect (default: the preset's)",
    )
