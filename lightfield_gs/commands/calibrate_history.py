"""`lightfield-gs calibrate history`: the states that a profile had."""

from __future__ import annotations

import argparse

from lightfield_gs.base.cli_messages import say, say_next
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.unknown import check_input
from lightfield_gs.panels.lens_history import LensState, read_history


def run(args: argparse.Namespace) -> None:
    """List the states of args.profile. Raises InputError."""
    history = read_history(args.profile)
    if not history.states:
        check_input(args.profile)
        raise InputError(f"{args.profile}: no history; it begins with the first change by `calibrate`")
    for state in history.states:
        say(f"{'*' if state.number == history.current else ' '} {state_line(state)}")
    if history.state(history.current).before is not None:
        say_next("calibrate", "undo", args.profile)


def state_line(state: LensState) -> str:
    """Return the line of a state: its number, when and by what it came."""
    return f"{state.number}: {state.when}, {state.what}"
