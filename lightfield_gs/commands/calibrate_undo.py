"""`lightfield-gs calibrate undo`: an earlier state of a profile, written back."""

from __future__ import annotations

import argparse

from lightfield_gs.base.cli_messages import say, say_next
from lightfield_gs.commands.calibrate_history import state_line
from lightfield_gs.commands.unknown import check_input
from lightfield_gs.panels.lens_history import history_path, undo


def run(args: argparse.Namespace) -> None:
    """Go back to a state of args.profile. Raises InputError."""
    if not history_path(args.profile).exists():  # else it is made anew from its history
        check_input(args.profile)
    before, after = undo(args.profile, args.to, args.device_serial)
    say(f"{args.profile}: undone: {before.what}", f"it is now {state_line(after)}")
    say_next("calibrate", "history", args.profile)
