"""The arguments of `lightfield-gs encode`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_quiet, add_stats
from lightfield_gs.commands.options.panel import add_drawing_device, add_encoding
from lightfield_gs.commands.options.parser import Parser
from lightfield_gs.commands.options.scene import SAVED_FORMATS, SCENE_FORMATS, SCENES
from lightfield_gs.commands.options.stereo import add_stereo


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs encode`."""
    parser.description = "Turn a photo, or a 3D scene, into the picture of a glasses-free 3D display."
    parser.epilog = (
        "A photo of one object before a plain background is shown alone; another one with its depths, which are "
        "in the file, beside it or estimated."
    )
    parser.text.examples = (
        ("encode photo.jpg -o out.png", "for the connected display"),
        ("encode scene.ply -o out.png --panel 27", "for a Looking Glass 27"),
        ("encode scene.ply -o out.png --turn 30", "from further right"),
        ("encode photo.jpg -o out.png --preview see", "and a page to look around"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "input",
        type=Path,
        metavar="INPUT",
        short=f"a photo; {SCENES}",
        help="a photo of an object (RGBA, or RGB with a plain background, --mask "
        f"or --remove-background), a photo of a scene with --depth, or a file of Gaussians ({SCENE_FORMATS})",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        short="the picture: .png, .tif or .exr",
        help=".png (8 or 16 bit), .tif or .exr (float)",
    )
    add_encoding(add)
    add("--save-rig", type=Path, metavar="YAML", help="write the rig of the image")
    add(
        "--save-gaussians",
        type=Path,
        metavar="SCENE",
        help=f"write the scene as {SAVED_FORMATS}; a .ply, .glb or .usd also has the framing, so that its encoding "
        "gives the same picture",
    )
    add(
        "--preview",
        type=Path,
        metavar="DIR",
        short="also views, a page to look around, and eyes' pictures",
        help="write views.png, look-around.webp and look-around.html (follows the mouse, can be sent); "
        "also left-eye.png and right-eye.png, if the panel has a pixel pitch and a viewing distance",
    )
    add_stereo(add)
    add_drawing_device(add)
    add_stats(add, "print the times of the stages, and what was drawn and skipped")
    add_quiet(add)
