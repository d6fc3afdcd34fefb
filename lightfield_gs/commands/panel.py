"""The panel of a command, and where its viewer stands."""

from __future__ import annotations

import argparse
from dataclasses import replace

from lightfield_gs.panel import Panel
from lightfield_gs.simulate import unknown_of

_REMEDIES = {"viewing_distance_mm": "give --viewing-distance MM",
             "pixel_pitch_mm": "give a panel that has it"}


def load_panel(args: argparse.Namespace) -> Panel:
    """The panel of --panel and --device-serial, seen from --viewing-distance, or from its own. Raises InputError."""
    return at_distance(Panel.load(args.panel, serial=args.device_serial), args.viewing_distance)


def at_distance(panel: Panel, viewing_distance_mm: float | None) -> Panel:
    """The panel, seen from this distance in mm; None: from its own."""
    return panel if viewing_distance_mm is None else replace(panel, viewing_distance_mm=viewing_distance_mm)


def why_no_eye(panel: Panel) -> str | None:
    """Why no eye can be placed before the panel, and what to do; None where one can."""
    missing = unknown_of(panel)
    if not missing:
        return None
    return f"panel {panel.name} lacks {' and '.join(missing)}; {', and '.join(_REMEDIES[key] for key in missing)}"
