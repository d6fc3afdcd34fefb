"""Depth, size and place of the scene on the panel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lightfield_gs.app.options import LookOptions
from lightfield_gs.base.cli_messages import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.gaussians import Gaussians

# Names of the options, and the fields of Look that they set
_FIELDS = {"focus": "focus", "depth_amount": "depth_amount", "cone": "cone_deg", "zoom": "zoom", "pan": "pan"}


def given_look(options: LookOptions) -> dict[str, Any]:
    """Return the options that were given, by their names."""
    return {name: value for name in _FIELDS if (value := getattr(options, name)) is not None}


def apply_look(options: LookOptions, rig: Rig, panel: Panel, gaussians: Gaussians) -> tuple[Rig, list[str]]:
    """Return the rig as the options want it, and lines on the result.

    Args:
        options: what is asked for.
        rig: the cameras so far.
        panel: the panel that shows the scene.
        gaussians: the scene, in the rig's coordinates.

    Raises:
        InputError: there is nothing at the point of --focus, or the options cannot be met.
    """
    if not (given := given_look(options)):
        return rig, []
    from lightfield_gs.panels.look import Look

    look = Look(**{_FIELDS[name]: value for name, value in given.items()})
    seen = look.applied(rig, panel, gaussians)
    cone = panel.cone_deg if seen.cone_deg is None else seen.cone_deg
    words = [f"depth {seen.zero_depth:.5g} in the panel's plane", f"a cone of {cone:.4g} degrees"]
    if look.zoom != 1:
        words.append(f"{look.zoom:g} times as large")
    if any(look.pan):
        words.append(f"moved by {look.pan[0]:g} of the width and {look.pan[1]:g} of the height")
    return seen, [f"look: {', '.join(words)}"]


def report_depth(
    options: LookOptions, rig: Rig, panel: Panel, gaussians: Gaussians, may_fill: bool = True
) -> list[str]:
    """Return the lines of --depth-report, and note what looks wrong with the depth.

    Without options, only outermost views that the scene does not fill are noted.

    Args:
        options: what was asked for.
        rig: the cameras.
        panel: the panel that shows the scene.
        gaussians: the scene, in the rig's coordinates.
        may_fill: whether the scene can fill the picture where nothing was steered.

    Raises:
        InputError: a report is asked for, and the rig shows nothing.
    """
    if not options.depth_report and not given_look(options):
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
    return report.lines() if options.depth_report else []


def refuse_look(options: LookOptions, reason: str) -> None:
    """Raise InputError for the first of the options that was given."""
    for name in given_look(options):
        raise InputError(f"--{name.replace('_', '-')} {reason}; leave out one of them")
