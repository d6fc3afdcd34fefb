"""`lightfield-gs calibrate`: make a profile fit its panel."""

from __future__ import annotations

import argparse
import importlib

ACTIONS = {
    "pattern": "write a native image that shows which view reaches an eye",
    "nudge": "change the lens of a profile a little",
    "fit": "estimate the lens from photographs of a pattern",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `lightfield-gs calibrate` and of its actions."""
    parser.description = "Calibrate the profile of a panel: show a pattern, look, and change the profile."
    actions = parser.add_subparsers(title="actions", required=True, metavar="ACTION", dest="action")
    for name, purpose in ACTIONS.items():
        action = actions.add_parser(
            name, help=purpose, description=f"{purpose[0].upper()}{purpose[1:]}.", allow_abbrev=False
        )
        importlib.import_module(f"lightfield_gs.commands.calibrate_{name}").add_arguments(action)


def run(args: argparse.Namespace) -> None:
    """Run the action. Raises InputError."""
    importlib.import_module(f"lightfield_gs.commands.calibrate_{args.action}").run(args)
