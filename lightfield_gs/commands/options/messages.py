"""Options of what a command says."""

from __future__ import annotations

from lightfield_gs.commands.options import groups
from lightfield_gs.commands.options.groups import Add, in_group


def add_messages(add: Add) -> None:
    """Add the options of what is said."""
    add_stats(add)
    add_quiet(add)


def add_stats(add: Add, help: str = "print the times of the stages") -> None:
    """Add the option of the times that the stages take."""
    in_group(add, groups.MESSAGES)("--stats", action="store_true", help=help)


def add_quiet(add: Add) -> None:
    """Add the option that leaves all but errors and notes out."""
    in_group(add, groups.MESSAGES)(
        "--quiet", action="store_true", help="print nothing but errors, and notes on results that may disappoint"
    )
