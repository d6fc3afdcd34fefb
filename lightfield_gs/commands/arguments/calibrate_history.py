"""The arguments of `lightfield-gs calibrate history`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.parser import Parser


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs calibrate history`."""
    parser.description = "List the changes of a calibration, each with its number for `calibrate undo --to`."
    parser.text.examples = (("calibrate history new.json", "what was changed, and when"),)
    add = in_group(parser.add_argument, groups.OWN)
    add("profile", type=Path, metavar="PROFILE", short="the calibration", help="a calibration that was changed")
