"""`lightfield-gs calibrate`: make a profile fit its panel."""

from __future__ import annotations

import argparse
import importlib


def run(args: argparse.Namespace) -> None:
    """Run the action. Raises InputError."""
    importlib.import_module(f"lightfield_gs.commands.calibrate_{args.action}").run(args)
