"""Options of the panel."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from lightfield_gs.commands.options.parser import within
from lightfield_gs.panels.panel import DEFAULT_PANEL


def add_panel(add: Callable[..., argparse.Action], purpose: str) -> None:
    """Add the options of the panel and of its viewing distance.

    Args:
        purpose: The use of the distance, for the help.
    """
    add(
        "--panel",
        default=DEFAULT_PANEL,
        metavar="PANEL",
        help=f"name of a profile, a .yaml or a Looking Glass visual.json (default {DEFAULT_PANEL})",
    )
    add_device_serial(add)
    add_viewing_distance(add, f"distance of the viewer from the panel, in place of the panel's own: {purpose}")


def add_device_serial(add: Callable[..., argparse.Action]) -> None:
    add(
        "--device-serial",
        metavar="SERIAL",
        help="serial number of the display, if a Looking Glass .json has several calibrations",
    )


def add_viewing_distance(add: Callable[..., argparse.Action], help: str) -> None:
    add("--viewing-distance", type=within(1e-3, 1e9, "mm"), metavar="MM", help=help)
