"""`lightfield-gs prune`: a scene without the Gaussians that hardly show on a panel."""

from __future__ import annotations

import argparse
from pathlib import Path

from lightfield_gs.app.cameras import choose_rig, comments_of, read_given
from lightfield_gs.app.look import apply_look
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.scene import check_scene_path, files_read, read_noted, say_origin, settle_drawing
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEVICES
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.cameras import add_camera, add_look
from lightfield_gs.commands.options.panel import add_panel
from lightfield_gs.commands.options.parser import within
from lightfield_gs.commands.options.scene import add_antialiased, add_reading, add_view_filter
from lightfield_gs.io.atomic import check_output_path, check_outputs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs prune`."""
    parser.description = (
        "Writes a scene without the Gaussians that contribute least to its image on a panel, from all "
        "viewpoints of the panel: it is drawn faster from then on."
    )
    add = parser.add_argument
    add("input", type=Path, metavar="INPUT", help="a file of Gaussians: .ply, .spz, .sog, .splat, .ksplat")
    add(
        "-o", "--output", type=Path, required=True, metavar="SCENE", help="the scene without them: .ply, .spz or .splat"
    )
    add_reading(add)
    add(
        "--contribution-cut",
        type=within(0, 1),
        default=3e-4,
        metavar="SHARE",
        help="0..1, mean error that colours of 0..1 may have for it (default 3e-4: 50 dB and more)",
    )
    add_antialiased(add)
    add_view_filter(add)
    add_panel(add, "for framing, as `encode` takes it")
    add_camera(add)
    add_look(add)
    add(
        "--save-rig",
        type=Path,
        metavar="YAML",
        help="write the rig that was used: automatic framing may see a pruned scene otherwise",
    )
    add("--device", choices=DEVICES, default="auto", help="where the scene is drawn (default auto)")


def run(args: argparse.Namespace) -> None:
    """Prunes args.input into args.output. Raises InputError."""
    watch = Stopwatch(args.began)
    check_scene_path(args.output)
    if args.save_rig is not None:
        check_output_path(args.save_rig)
    check_outputs((args.output, args.save_rig), files_read(args))
    panel = load_panel(args)
    device = choose_device(args.device)

    from lightfield_gs.encoding.pruning import prune

    given = read_given(args, panel)
    watch.lap("start")
    file = read_noted(args.input, args.skip_invalid, args.time)
    scene = file.gaussians
    say_origin(args.input, scene)
    drawn_so = settle_drawing(args, file)
    watch.lap("load")
    on_device = scene.to(device)
    chosen, messages = choose_rig(given, args, panel, on_device, file)
    rig, looks = apply_look(args, chosen, panel, on_device)
    messages += looks
    rig_of_file = rig.relative_to([-part for part in scene.origin])
    kept = prune(on_device, panel, rig, args.contribution_cut, args.antialiased, args.view_filter)
    watch.lap("prune")
    if kept.count == 0:
        raise InputError(
            f"{args.output}: nothing would be left of {scene.count} Gaussians; give a smaller "
            "--contribution-cut or another --rig"
        )
    kept.to("cpu").save(args.output, comments_of(args, panel, file, rig_of_file))
    if args.save_rig is not None:
        rig_of_file.to_yaml(args.save_rig)
    watch.lap("write")
    print(
        f"{args.output}: {kept.count} of {scene.count} Gaussians, the others within {args.contribution_cut:g} of the "
        f"light of {panel.width_px} x {panel.height_px}, {panel.views} views"
    )
    print(watch.line())
    if args.output.suffix.lower() == ".ply":
        messages.append(
            f"{args.output}: in the axes of {args.input}, with the framing it was pruned for: encode takes it"
        )
    print("\n".join(drawn_so + messages))
