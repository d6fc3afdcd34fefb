"""The arguments of `lightfield-gs calibrate`."""

from __future__ import annotations

import importlib
from functools import partial

from lightfield_gs.commands.options.parser import Parser

ACTIONS = {
    "page": "calibrate by eye: a page on the display leads through it",
    "pattern": "write a test picture that shows which view reaches an eye",
    "nudge": "change the lens in a calibration a little",
    "fit": "estimate the lens from photographs of test pictures",
    "undo": "take the last change of a calibration back",
    "history": "list the changes of a calibration",
}


def add_arguments(parser: Parser) -> None:
    """Add the arguments of `lightfield-gs calibrate` and of its actions."""
    parser.description = "Make a calibration fit its display: show a test picture, look, and change the lens."
    parser.text.examples = (
        ("calibrate page visual.json -o new.json", "by eye, on the display"),
        ("calibrate pattern pitch --panel visual.json -o p.png", "a test picture"),
        ("calibrate nudge visual.json -o new.json --pitch-by 0.1%", "change the lens by what it says"),
        ("calibrate undo new.json", "and back"),
    )
    parser.text.footer = "Each action explains itself: lightfield-gs calibrate ACTION --help"
    parser.text.sections = {"actions": ACTIONS}
    actions = parser.add_subparsers(title="actions", required=True, metavar="ACTION", dest="action")
    for name in ACTIONS:
        actions.add_parser(name, fill=partial(_fill, name), allow_abbrev=False)


def _fill(name: str, parser: Parser) -> None:
    importlib.import_module(f"lightfield_gs.commands.arguments.calibrate_{name}").add_arguments(parser)
