"""`lightfield-gs prune`: a scene without the Gaussians that hardly show on a panel."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

from lightfield_gs.app.scene import LoadedScene
from lightfield_gs.base.cli_messages import Stopwatch
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.smaller import Smaller, SmallerOptions, make_smaller, smaller
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig


@dataclass(frozen=True, slots=True, kw_only=True)
class PruneOptions(SmallerOptions):
    """A scene that loses what hardly shows on a panel.

    Attributes:
        contribution_cut: mean error that colours of 0..1 may have.
    """

    contribution_cut: float


def run(args: argparse.Namespace) -> None:
    """Prune args.input into args.output. Raises InputError."""
    options = read_options(PruneOptions, args)

    def pruned(scene: LoadedScene, panel: Panel, rig: Rig) -> Smaller:
        from lightfield_gs.simplification.pruning import prune

        render, cut = scene.render, options.contribution_cut
        kept = prune(scene.gaussians, panel, rig, cut, bool(render.antialiased), render.view_filter)
        return smaller(scene.gaussians, kept, f"the others within {cut:g} of the light", panel)

    make_smaller(options, Stopwatch(args.began), pruned)
