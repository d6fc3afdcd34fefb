"""The arguments of `lightfield-gs page`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_messages
from lightfield_gs.commands.options.panel import add_camera, add_device, add_look, add_panel, add_rendering
from lightfield_gs.commands.options.parser import Parser
from lightfield_gs.commands.options.scene import add_input, add_scene


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs page`."""
    parser.description = (
        "Make one file of a photo or a scene, to send: whoever opens it in a browser can turn the scene."
    )
    parser.epilog = (
        "On a 3D display the page fills it, pixel for pixel. It loads nothing from elsewhere. Without --panel it "
        "asks its reader for the calibration of the display, visual.json."
    )
    parser.text.examples = (
        ("page photo.jpg -o photo.html", "for any screen, and any 3D display"),
        ("page scene.ply --panel visual.json -o scene.html", "for your display"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add_input(add)
    add("-o", "--output", type=Path, required=True, metavar="FILE", short="the page, .html", help="the page, .html")
    add("--title", metavar="WORDS", short="title of the page", help="title of the page (default: the input's name)")
    add_panel(add, "for framing")
    add_camera(add)
    add_look(add)
    add_scene(add, "cut the object out of a photo with rembg, as in `encode`")
    add_rendering(add)
    add_device(add)
    add_messages(add)
