"""The arguments of `lightfield-gs calibrate fit`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_quiet
from lightfield_gs.commands.options.panel import add_device_serial, add_viewing_distance
from lightfield_gs.commands.options.parser import Parser, numbers, panel_name


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs calibrate fit`."""
    parser.description = "Estimate the lens of a display from photographs of test pictures."
    parser.epilog = (
        "Photograph `calibrate pattern phase --shift 0`, 1 and 2 of exactly the profile START, shown full "
        "screen and unscaled, in a dark room. Do so from two places at least, a twentieth of the viewing "
        "zone apart, best at the viewing distance. Only the pattern may change between the three: use the "
        "same exposure and white balance, no clipping, and a stand. One photograph of `calibrate pattern "
        "rgb` from each place is quicker; its accuracy depends on how well the camera separates colours."
    )
    parser.text.examples = (
        ("calibrate fit shots.yaml --panel visual.json -o new.json", "places and photographs by a list"),
        (
            "calibrate fit *.jpg --panel old.json --eye 0,0,600 --one-place -o new.json",
            "three photographs from one place",
        ),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "photos",
        nargs="+",
        type=Path,
        metavar="PHOTO",
        short="photographs of shift 0, 1, 2 from each place; or a .yaml",
        help="the photographs of shift 0, 1 and 2 from the first place, then from the next; or a .yaml with a "
        "list places, each with eye_mm, photos and optionally corners_px",
    )
    add(
        "--panel",
        type=panel_name,
        required=True,
        metavar="START",
        short="the calibration of the test pictures",
        help="the profile of the pattern: name, .yaml or .json",
    )
    add_device_serial(add)
    add_viewing_distance(add, "design distance of the lens, if START does not state it")
    add(
        "--eye",
        type=numbers(3),
        action="append",
        metavar="X,Y,Z",
        short="camera in mm from the middle: right, up, towards you",
        help="position of the camera in mm from the panel's middle: right (as the viewer sees it), up, towards "
        "the viewer; once for each place",
    )
    add(
        "--corners",
        type=numbers(8),
        action="append",
        metavar="X,Y,...",
        short="corners of the display in the photographs, pixels",
        help="corners of the panel in the photographs, in pixels from their upper left: upper left, upper "
        "right, lower right, lower left; once for each place (default: found automatically, which needs a "
        "dark room)",
    )
    add(
        "--one-place",
        action="store_true",
        short="accept photographs from one place",
        help="accept photographs from one place; order, mirroring and position of the eye are then not checked",
    )
    add(
        "--refine",
        action="store_true",
        short="compare every sub-pixel, in a minute or more",
        help="refine the lens by what a camera should see of every sub-pixel; for lenses in a simple ratio to the "
        "sub-pixels (a slant of 1/3, 1/4 or 0), whose bars move in steps; about a minute for a million pixels",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="NEW",
        short="the calibration with the lens that was found",
        help="START with the estimated lens, in its own format",
    )
    add_quiet(add)
