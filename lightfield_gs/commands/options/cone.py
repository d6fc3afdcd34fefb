"""Options of `lightfield-gs fit` for a scene that a panel is to show."""

from __future__ import annotations

import argparse
from typing import Any

from lightfield_gs.commands.options.values import within


def add_cone(parser: argparse.ArgumentParser) -> None:
    """The panel that a scene is fitted for, and the cone that it is judged in."""
    add = parser.add_argument_group("panel").add_argument
    add(
        "--cone",
        metavar="PANEL|DEG",
        help="fits for what a panel shows: its name, .yaml or .json, or the full angle of its cone in degrees (1..179, "
        "then of the default panel). Photographs in the cone count fully, others less; Gaussians that no view of the "
        "panel sees are left out; the rig is written beside the scene, scene.rig.yaml for scene.ply",
    )
    add(
        "--centre",
        metavar="NAME",
        help="the photograph in the middle of the cone, its centre camera (default: the one with the most others near)",
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
        help="0..1, mean error that colours of 0..1 may have on the panel for what is left out (default 1e-4)",
    )


def cone_given(args: argparse.Namespace) -> dict[str, Any]:
    """The arguments of lf.fit that the options are."""
    cut = {} if args.contribution_cut is None else {"contribution_cut": args.contribution_cut}
    return {"cone": args.cone, "centre": args.centre, "score_cone": args.score_cone, **cut}
