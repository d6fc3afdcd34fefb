"""Options of pictures for two eyes."""

from __future__ import annotations

from lightfield_gs.base.options import STEREO_LAYOUTS
from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import Add, in_group
from lightfield_gs.commands.options.parser import whole_numbers, within


def add_stereo(add: Add, whose: str = "--stereo") -> None:
    """Add the options of the layout of two eyes' pictures, of the screen, and of the eyes before it; see add_viewer."""
    add = in_group(add, groups.EYES)
    add(
        "--stereo",
        choices=STEREO_LAYOUTS,
        short="for two eyes instead: sbs, tab, mpo, anaglyph, ...",
        help="pictures of two eyes in place of the image of a panel. sbs: side by side; half-sbs: the same, squeezed "
        "to one picture's width; tab: left eye on top; mpo: two pictures in one .mpo; anaglyph: for red and cyan "
        "glasses; left-right: two files. Names get what players read: _LRF_Full_SBS, _half_2x1, _LR_Full_TAB",
    )
    add_viewer(add, whose)
    add(
        "--eye-size",
        type=whole_numbers(2, 16384, "x", 2),
        metavar="WIDTHxHEIGHT",
        help=f"of {whose}: pixels of one eye's picture, or of a plain screen (default 1920x1080)",
    )


def add_viewer(add: Add, whose: str) -> None:
    """Add the options of the distance between the eyes and of the size of a plain screen; whose: options they are."""
    add(
        "--eye-distance",
        type=within(20, 120, "mm"),
        metavar="MM",
        help=f"of {whose}: distance between the eyes (default: as asked for once at a terminal and kept, else 63)",
    )
    add(
        "--screen-size",
        type=within(0.5, 2000, "inches"),
        metavar="INCHES",
        help=f"of {whose}: diagonal of the screen (default: as kept, else 27); with --viewing-distance "
        "(default: 0.875 of it) it sets the depth that does not strain the eyes",
    )
