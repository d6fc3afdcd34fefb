"""`lightfield-gs bench skips`: what each skip of what a scene does not need saves."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from lightfield_gs.bench import pareto, skips
from lightfield_gs.bench.scenes import benchmark_rig, load_scene
from lightfield_gs.commands.options import bench as options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    options.add_scene(parser, skips.SCENES)
    options.add_panel(parser)
    options.add_cone(parser)
    options.add_sh_degree(parser)
    options.add_repeats(parser)
    options.add_machine(parser)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Rows of every skip, for every scene and cone, and their text."""
    scenes, panel = skips.SCENES if args.scene is None else args.scene.split(","), options.panel_of(args)
    cones, count = options.cones(args.cone), options.one_thread_count(args.threads)
    degrees, found = options.sh_degrees(args.sh_degree), []
    options.check_scenes(scenes, degrees)
    for scene in scenes:
        for degree in degrees:
            gaussians = load_scene(scene, degree).to(args.device)
            for cone in cones:
                rig = benchmark_rig(scene, gaussians, panel, cone)
                subject = pareto.Subject(Path(scene).name, gaussians, panel, rig)
                options.progress(f"{subject.name}, {rig.cone_deg:g} degrees: with and without every skip by turns")
                found += skips.rows(subject, args.repeats, count)
    return {"rows": found}, skips.table(found)
