"""The arguments of `lightfield-gs show`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.options import StereoLayout
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.panel import add_device_serial
from lightfield_gs.commands.options.parser import Parser, panel_name
from lightfield_gs.commands.options.serving import add_serving

_LAYOUTS: tuple[StereoLayout, ...] = ("sbs", "half-sbs", "tab", "anaglyph")


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs show`."""
    parser.description = "Show a picture on the 3D display, full screen."
    parser.epilog = (
        "A browser shows it pixel for pixel. A large warning appears if it is scaled or on another screen. Ctrl-C "
        "ends it."
    )
    parser.text.examples = (("show out.png", "a picture of `encode`"), ("show pair_2x1.jpg", "a stereo picture"))
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "image",
        type=Path,
        metavar="IMAGE",
        short="a picture that `encode` wrote, or a stereo picture",
        help="an encoded image, as `encode` writes it",
    )
    add(
        "--panel",
        type=panel_name,
        metavar="PANEL",
        short="the display (default: as the picture says)",
        help="name, .yaml or visual.json (default: the profile in the image, else the display that is connected)",
    )
    add_device_serial(add)
    add(
        "--stereo",
        choices=_LAYOUTS,
        short="how a stereo picture fills the screen: sbs, tab, ...",
        help="fill a screen of two eyes with a stereo picture: side by side, one above the other, or as an anaglyph "
        "(default sbs, for pictures whose file or name says that they are stereo)",
    )
    add_serving(add)
