"""The arguments of `lightfield-gs show`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.base.options import StereoLayout
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.panel import add_device_serial
from lightfield_gs.commands.options.parser import Parser, panel_name, within
from lightfield_gs.commands.options.serving import add_serving

_LAYOUTS: tuple[StereoLayout, ...] = ("sbs", "half-sbs", "tab", "anaglyph")


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs show`."""
    parser.description = "Show pictures and films on the 3D display, full screen."
    parser.epilog = (
        "A browser shows them pixel for pixel, on the display that was found. A large warning appears if they are "
        "scaled or on another screen. H lists the keys, Ctrl-C ends it."
    )
    parser.text.examples = (
        ("show out.png", "a picture of `encode`"),
        ("show evening --shuffle", "a folder, in turn"),
        ("show pair_2x1.jpg", "a stereo picture"),
        ("show loop_qs8x6a0.75.mp4 --wall", "all day long"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add(
        "inputs",
        type=Path,
        nargs="+",
        metavar="INPUT",
        short="pictures of `encode`, quilts, films, stereo pictures; folders of them",
        help="what is shown in turn: images as `encode` writes them, quilts, stereo pictures; films of native frames, "
        "of quilts or of two eyes; folders of all these, and folders of frames as `video` writes them",
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
    add = in_group(parser.add_argument, groups.MOTION)
    add(
        "--seconds",
        type=within(0, 86400),
        default=10.0,
        metavar="S",
        short="of each picture (default 10; 0: by the keys)",
        help="of each picture (default 10); films are shown to their end. 0: all stay until a key is pressed",
    )
    add(
        "--shuffle",
        action="store_true",
        short="in an order by chance",
        help="in an order by chance, a new one each round",
    )
    add("--once", action="store_true", help="stop at the last one (default: begin again)")
    add(
        "--fade",
        type=within(0, 60),
        default=0.5,
        metavar="S",
        help="seconds in which one goes over into the next (default 0.5; 0: at once)",
    )
    add(
        "--wall",
        action="store_true",
        short="for exhibitions: starts again by itself",
        help="for exhibitions: the browser fills the display without a way out, and it and the server are started "
        "again where they end or no longer answer; Ctrl-C ends it",
    )
    add_serving(add)
