"""The arguments of `lightfield-gs calibrate page`."""

from __future__ import annotations

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.panel import add_changed_profile
from lightfield_gs.commands.options.parser import Parser
from lightfield_gs.commands.options.serving import add_serving


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs calibrate page`."""
    parser.description = "Calibrate by eye: a page on the display leads through pitch, slope and centre."
    parser.epilog = (
        "The page shows a pattern full screen, and beside it what right looks like. Arrow keys move the lens, S saves "
        "it. What the calibration was is kept: `calibrate undo`. Ctrl-C ends the page."
    )
    parser.text.examples = (("calibrate page visual.json -o new.json", "then move the page to the display"),)
    add = in_group(parser.add_argument, groups.OWN)
    add_changed_profile(add)
    add_serving(add)
