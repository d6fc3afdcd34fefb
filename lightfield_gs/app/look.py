"""How the scene is to look on the panel: depth, size and place."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.gaussians import Gaussians

# Names of the options, and the fields of Look that they set
_FIELDS = {"focus": "focus", "depth_amount": "depth_amount", "cone": "cone_deg", "zoom": "zoom", "pan": "pan"}


def report_depth(
    args: argparse.Namespace, rig: Rig, panel: Panel, gaussians: Gaussians, may_fill: bool = True
) -> list[str]:
    """The lines of --depth-report, [] where it was not given; notes where a scene that fills the picture does not fill
    the outermost views, and all that looks wrong where depth or place were steered, or asked about.

    gaussians: in the rig's coordinates; may_fill: whether they can fill the picture where nothing was steered. Raises
    InputError where it was asked about, and the rig shows nothing.
    """
    is_asked = getattr(args, "depth_report", False)  # not every command has it
    if not is_asked and not is_given(args):
        if not may_fill:
            return []
        from lightfield_gs.panels.visibility import background_fraction, background_warning

        past = background_fraction(gaussians, panel, rig)
        if past is not None and (words := background_warning(past)) is not None:
            note(words)
        return []
    from lightfield_gs.panels.comfort import depth_report

    report = depth_report(gaussians, panel, rig)
    for words in report.warnings():
        note(words)
    return report.lines() if is_asked else []


def is_given(args: argparse.Namespace) -> bool:
    """Whether any of the options was."""
    return any(getattr(args, name) is not None for name in _FIELDS)


def refuse_look(args: argparse.Namespace, reason: str) -> None:
    """Raises InputError for the first of the options that was given."""
    for name in _FIELDS:
        if getattr(args, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} {reason}; leave out one of them")


def apply_look(args: argparse.Namespace, rig: Rig, panel: Panel, gaussians: Gaussians) -> tuple[Rig, list[str]]:
    """The rig as the options want it, and lines on what they made of it. gaussians: in the rig's coordinates.

    Raises InputError, also where there is nothing at the point of --focus.
    """
    if not is_given(args):
        return rig, []
    from lightfield_gs.panels.look import Look

    given = {field: getattr(args, name) for name, field in _FIELDS.items() if getattr(args, name) is not None}
    look = Look(**given)
    seen = look.applied(rig, panel, gaussians)
    cone = panel.cone_deg if seen.cone_deg is None else seen.cone_deg
    words = [f"depth {seen.zero_depth:.5g} in the panel's plane", f"a cone of {cone:.4g} degrees"]
    if look.zoom != 1:
        words.append(f"{look.zoom:g} times as large")
    if any(look.pan):
        words.append(f"moved by {look.pan[0]:g} of the width and {look.pan[1]:g} of the height")
    return seen, [f"look: {', '.join(words)}"]
