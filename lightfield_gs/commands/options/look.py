"""How the scene is to look on the panel: depth, size and place, as options of every command that draws one."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from lightfield_gs.base.complaint import note
from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.options.values import numbers, within
from lightfield_gs.panels.panel import Panel

if TYPE_CHECKING:
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.scene.gaussians import Gaussians

# Names of the options, and the fields of Look that they set
_FIELDS = {"focus": "focus", "depth_amount": "depth_amount", "cone": "cone_deg", "zoom": "zoom", "pan": "pan"}


def add_look(add: Callable[..., argparse.Action]) -> None:
    """Focus, amount of depth, cone, zoom and pan. Each is None where it was not given."""
    add(
        "--focus",
        type=_focus,
        metavar="DEPTH|X,Y",
        help="what lies in the panel's plane: a depth before the camera in scene units, or a point of the picture, X "
        "of its width from the left and Y of its height from the top, 0..1 each: the surface seen there (default: that "
        "of the rig, or automatic)",
    )
    add(
        "--depth-amount",
        type=within(0, 2),
        metavar="FACTOR",
        help="how deep the scene is, 0 (flat) to 2: factor of all disparities (default 1)",
    )
    add(
        "--cone",
        type=within(0, 179, "degrees"),
        metavar="DEG",
        help="full angle that the cameras of the views span, in degrees, 0..179 (default: the rig's or the panel's)",
    )
    add("--zoom", type=within(0.01, 100), metavar="FACTOR", help="size of the picture, about its middle (default 1)")
    add(
        "--pan",
        type=_pan,
        metavar="X,Y",
        help="moves the picture to the right by X of the panel's width and down by Y of its height (default 0,0)",
    )


def add_depth_report(add: Callable[..., argparse.Action]) -> None:
    add(
        "--depth-report",
        action="store_true",
        help="print how deep the scene is on the panel, in px and mm: disparities, what stands before and behind the "
        "panel, whether that is comfortable, what is sharp, and what the outermost views show that nobody has seen",
    )


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


def _focus(text: str) -> float | tuple[float, ...]:
    """ "2.5" -> 2.5, a depth; "0.5,0.4" -> (0.5, 0.4), a point of the picture."""
    if "," not in text:
        depth = numbers(1)(text)[0]
        if not 1e-6 <= depth <= 1e12:
            raise argparse.ArgumentTypeError(f"expected a depth of 1e-06..1e+12 scene units, got '{text}'")
        return depth
    point = numbers(2)(text)
    if not all(0 <= part <= 1 for part in point):
        raise argparse.ArgumentTypeError(f"expected a point X,Y of the picture, 0..1 each, got '{text}'")
    return point


def _pan(text: str) -> tuple[float, ...]:
    """ "-0.1,0.2" -> (-0.1, 0.2)."""
    pan = numbers(2)(text)
    if not all(math.fabs(part) <= 10 for part in pan):
        raise argparse.ArgumentTypeError(f"expected shares of the panel's width and height, -10..10, got '{text}'")
    return pan
