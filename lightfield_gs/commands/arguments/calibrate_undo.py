"""The arguments of `lightfield-gs calibrate undo`."""

from __future__ import annotations

from pathlib import Path

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import in_group
from lightfield_gs.commands.options.messages import add_quiet
from lightfield_gs.commands.options.panel import add_device_serial
from lightfield_gs.commands.options.parser import Parser, whole


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs calibrate undo`."""
    parser.description = "Take the last change of a calibration back."
    parser.epilog = (
        "Every change by `calibrate` is kept in NAME.history.jsonl beside the calibration, undone ones too: nothing "
        "is lost. A change by hand is kept when it is undone."
    )
    parser.text.examples = (
        ("calibrate undo new.json", "back by one change"),
        ("calibrate undo new.json --to 1", "as it was at first"),
    )
    add = in_group(parser.add_argument, groups.OWN)
    add("profile", type=Path, metavar="PROFILE", short="the calibration", help="a calibration that was changed")
    add(
        "--to",
        type=whole(1, 1_000_000),
        metavar="N",
        short="the number of a state, as `calibrate history` lists it",
        help="the state to go back to, or forth to, by its number in `calibrate history` (default: the one before)",
    )
    add_device_serial(add)
    add_quiet(add)
