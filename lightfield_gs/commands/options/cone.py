"""Options of `lightfield-gs fit` for a scene that a panel is to show."""

from __future__ import annotations

import argparse
from typing import Any

from lightfield_gs.base.errors import InputError
from lightfield_gs.commands.options.values import within


def add_cone(parser: argparse.ArgumentParser) -> None:
    """The panel that a scene is fitted for, and the cone that it is judged in."""
    add = parser.add_argument_group("panel").add_argument
    add(
        "--cone",
        metavar="PANEL|DEG",
        help="fits for what a panel shows, given by its name, .yaml or .json, or for the default panel with a cone of "
        "so many degrees, 1..179, from end to end. Photographs in the cone count fully, others less; Gaussians that "
        "no view of the panel sees are left out; the rig is written beside the scene, scene.rig.yaml for scene.ply "
        "(default: all photographs count alike)",
    )
    add(
        "--centre",
        metavar="NAME",
        help="name of the photograph in the middle of the cone, taken by its centre camera (default: the one with the "
        "most others near)",
    )
    add(
        "--score-cone",
        type=within(1, 179, "degrees"),
        metavar="DEG",
        help="scores held-out photographs by their angle in a cone of this full angle, without --cone too, so that a "
        "fit for a cone and one for all photographs are compared (default: the cone of --cone)",
    )
    add(
        "--contribution-cut",
        type=within(0, 1),
        metavar="SHARE",
        help="0..1, mean error that colours of 0..1 may have on the panel for what --cone leaves out (default 1e-4)",
    )


def check_cone(args: argparse.Namespace) -> None:
    """Raises InputError where --cone is neither a panel nor an angle: at once, not after the capture was read."""
    from lightfield_gs.fitting.display import panel_of

    if args.cone is None:
        return
    try:
        panel_of(args.cone)
    except InputError as error:
        raise InputError(f"--cone: expected a panel, or degrees, 1..179: {error}") from None


def cone_given(args: argparse.Namespace) -> dict[str, Any]:
    """The arguments of lf.fit that the options are."""
    cut = {} if args.contribution_cut is None else {"contribution_cut": args.contribution_cut}
    return {"cone": args.cone, "centre": args.centre, "score_cone": args.score_cone, **cut}
