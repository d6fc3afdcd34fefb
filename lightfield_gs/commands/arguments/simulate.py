"""The arguments of `lightfield-gs simulate`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_messages
from lightfield_gs.commands.options.panel import add_device_serial, add_viewing_distance
from lightfield_gs.commands.options.parser import Parser, numbers, panel_name, within


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs simulate`."""
    parser.description = "Show what an eye before the display sees of a picture, through the lenses."
    parser.text.examples = (
        ("simulate out.png -o eyes.png", "a viewer's two eyes"),
        ("simulate out.png --eye 0,0,700 -o eye.png", "one in the middle"),
        ("simulate out.png --eyes -100,100,5 -o row.png", "five eyes in a row"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "image",
        type=Path,
        metavar="IMAGE",
        short="a picture that `encode` wrote",
        help="an encoded image, as `encode` writes it",
    )
    add(
        "--panel",
        type=panel_name,
        metavar="PANEL",
        short="the display (default: as the picture says)",
        help="name, .yaml or visual.json (default: the profile stored in the image)",
    )
    add_device_serial(add)
    add_viewing_distance(add, "distance at which an eye sees one view all over the panel, in place of the panel's own")
    add(
        "--eye",
        type=numbers(3),
        metavar="X,Y,Z",
        short="the eye in mm from the middle: right, up, towards you",
        help="position of the eye in mm from the panel's centre: right, up, towards the viewer (default: a viewer's "
        "two eyes, at the viewing distance)",
    )
    add(
        "--eyes",
        type=numbers(3),
        metavar="FROM,TO,COUNT",
        short="COUNT eyes side by side, FROM..TO in mm",
        help="in place of --eye: COUNT eyes side by side at the viewing distance, from FROM to TO mm right of "
        "the panel's middle; the result has rows of four pictures",
    )
    add(
        "--spread",
        type=within(0.01, 1000, "sub-pixels"),
        metavar="SUBPIXELS",
        short="sub-pixels that a lens lights (default 1)",
        help="width that a lens lights, in sub-pixels; more is crosstalk (default 1)",
    )
    add(
        "--psf",
        type=Path,
        metavar="FILE",
        help="in place of --spread: measured brightness of the sub-pixels beside the right one. Each line has a "
        "distance to the right in sub-pixels, and the light (any unit)",
    )
    add(
        "--lens-pixels",
        action="store_true",
        help="one pixel a lens, as an .exr always has it (default: enlarged, so that the picture fills a screen)",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        short="what is seen: .png, .tif or .exr",
        help=".png, .tif or .exr",
    )
    add_messages(add)
