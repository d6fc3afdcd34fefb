"""The rig of a command, and whether it is one for the panel."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.commands.complaint import note
from lightfield_gs.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.rig import Rig


def load_rig(args: argparse.Namespace, panel: Panel) -> "Rig | None":
    """The rig of --rig, if there is one; says where it looks like one of another panel. Raises InputError."""
    from lightfield_gs.rig import Rig

    if args.rig is None:
        return None
    rig = Rig.from_yaml(args.rig)
    note_of_centre(args.rig, rig.principal_point_px, panel)
    return rig


def note_of_centre(path: Path, principal_point_px: Sequence[float], panel: Panel) -> None:
    """Says where cameras' lengths look as if they counted pixels of another panel: then the principal point is off the
    middle in both directions alike. In one alone it is where the content is beside the axis and was centred."""
    size = panel.width_px, panel.height_px
    places = [centre / pixels for centre, pixels in zip(principal_point_px, size)]
    if max(places) < 0.3 or min(places) > 0.7:
        x, y = principal_point_px
        note(f"{path}: its principal point ({x:g}, {y:g}) is far from the middle of the panel's {size[0]} x {size[1]} "
             "pixels; if it was made for a panel of another size, scale focal_px and principal_point_px by the ratio")
