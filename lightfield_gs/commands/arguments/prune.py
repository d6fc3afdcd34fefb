"""The arguments of `lightfield-gs prune`."""

from __future__ import annotations

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.parser import Parser, within
from lightfield_gs.commands.options.smaller import add_drawing, add_scenes


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs prune`."""
    parser.description = "Make a scene smaller: leave out what hardly shows on a display."
    parser.epilog = (
        "The contribution of each Gaussian counts from all viewpoints of the panel. The scene is then faster to draw."
    )
    parser.text.examples = (
        ("prune scene.ply -o small.ply", "for the connected display"),
        ("prune scene.ply -o small.spz --panel 27", "for a Looking Glass 27"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add_scenes(add)
    add(
        "--contribution-cut",
        type=within(0, 1),
        default=3e-4,
        metavar="FRACTION",
        short="0..1: allowed mean error (default 3e-4)",
        help="0..1, allowed mean error of colours in 0..1 (default 3e-4: 50 dB and more)",
    )
    add_drawing(add)
