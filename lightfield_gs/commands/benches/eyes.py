"""`lightfield-gs bench eyes`: what eyes across the cone see, with and without the view filter."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from lightfield_gs.bench import eyes, pareto
from lightfield_gs.bench.scenes import benchmark_rig, load_scene
from lightfield_gs.commands.options import bench as options

_SCENES = ("sheet:128",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    options.add_scene(parser, _SCENES)
    options.add_panel(parser)
    options.add_cone(parser)
    options.add_sh_degree(parser)
    options.add_machine(parser)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """Rows of every width of the view filter, for every scene and cone, and their text."""
    scenes, panel = _SCENES if args.scene is None else args.scene.split(","), options.panel_of(args)
    eyes.check_panel(panel)
    cones, degrees = options.cones(args.cone), options.sh_degrees(args.sh_degree)
    torch.set_num_threads(options.one_thread_count(args.threads) or torch.get_num_threads())
    found: list[dict[str, Any]] = []
    options.check_scenes(scenes, degrees)
    for scene in scenes:
        for degree in degrees:
            gaussians = load_scene(scene, degree).to(args.device)
            for cone in cones:
                rig = benchmark_rig(scene, gaussians, panel, cone)
                options.progress(f"{Path(scene).name}, {rig.cone_deg:g} degrees: {eyes.EYES} eyes")
                found += eyes.rows(pareto.Subject(Path(scene).name, gaussians, panel, rig))
    return {"rows": found}, eyes.table(found)
