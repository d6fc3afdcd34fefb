"""`lightfield-gs bench pareto`: run time against error over the settings of quality."""

from __future__ import annotations

import argparse
from typing import Any

from lightfield_gs.bench import pareto, photo
from lightfield_gs.bench.pareto_plot import check_plot, plot
from lightfield_gs.commands.options import bench as options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    options.add_scene(parser, pareto.SCENES)
    options.add_photo(parser, photo.EXAMPLE)
    options.add_panel(parser)
    options.add_cone(parser, "5,40")
    options.add_plot(parser)
    options.add_repeats(parser)
    options.add_machine(parser)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Rows of every scene, photo, cone and setting, and their text; draws the plot."""
    if args.plot is not None:
        check_plot(args.plot)
    photos = [] if args.scene and not args.photo else (args.photo or str(photo.EXAMPLE)).split(",")
    options.check_photos(photos)
    scenes = pareto.SCENES if not args.scene and not args.photo else args.scene.split(",") if args.scene else ()
    options.check_scenes(scenes)
    found: list[dict[str, Any]] = []
    count = options.one_thread_count(args.threads)
    cones = pareto.CONES if args.cone is None else options.cones(args.cone)
    for subject in pareto.subjects(scenes, photos, options.panel_of(args), cones, args.device):
        made = subject()
        options.progress(f"{made.name}, {made.rig.cone_deg:g} degrees: oracle, then all settings by turns")
        found += pareto.rows(made, pareto.settings(), args.repeats, count)
    if args.plot is not None:
        plot(found, args.plot)
    return {"rows": found}, pareto.table(found)
