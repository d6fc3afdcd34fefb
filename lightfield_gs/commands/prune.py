"""`lightfield-gs prune`: a scene without the Gaussians that hardly show on a panel."""

from __future__ import annotations

import argparse

from lightfield_gs.commands.device import choose_device
from lightfield_gs.commands.panel import load_panel
from lightfield_gs.commands.rig import load_rig
from lightfield_gs.commands.scene import check_scene_path
from lightfield_gs.commands.stopwatch import Stopwatch
from lightfield_gs.errors import InputError
from lightfield_gs.io.atomic import check_output_path, check_outputs


def run(args: argparse.Namespace) -> None:
    """Prunes args.input into args.output. Raises InputError."""
    watch = Stopwatch(args.began)
    check_scene_path(args.output)
    if args.save_rig is not None:
        check_output_path(args.save_rig)
    check_outputs((args.output, args.save_rig), (args.input, args.rig, args.panel))
    panel = load_panel(args)
    device = choose_device(args.device)

    from lightfield_gs.gaussians import Gaussians
    from lightfield_gs.pruning import prune
    from lightfield_gs.rig import Rig

    rig = load_rig(args, panel)
    watch.lap("start")
    scene = Gaussians.load(args.input)
    watch.lap("load")
    on_device = scene.to(device)
    rig = rig or Rig.frame(on_device, panel)
    kept = prune(on_device, panel, rig, args.contribution_cut, args.antialiased)
    watch.lap("prune")
    if kept.count == 0:
        raise InputError(f"{args.output}: nothing would be left of {scene.count} Gaussians; give a smaller "
                         "--contribution-cut or another --rig")
    kept.to("cpu").save(args.output)
    if args.save_rig is not None:
        rig.to_yaml(args.save_rig)
    watch.lap("write")
    print(f"{args.output}: {kept.count} of {scene.count} Gaussians, the others within {args.contribution_cut:g} of the "
          f"light of {panel.width_px} x {panel.height_px}, {panel.views} views")
    print(watch.line())
