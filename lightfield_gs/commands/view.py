"""`lightfield-gs view`: a page in the browser that shows a scene as the panel would, and steers it."""

from __future__ import annotations

import argparse
from pathlib import Path

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.options import DEVICES
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.camera import add_camera, choose_rig, read_given
from lightfield_gs.commands.options.drawn import add_antialiased, add_background, settle_drawing
from lightfield_gs.commands.options.look import add_look, apply_look
from lightfield_gs.commands.options.panel import add_panel, load_panel
from lightfield_gs.commands.options.photo import add_depth
from lightfield_gs.commands.options.scene import add_skip_invalid, check_scene_options, load_scene
from lightfield_gs.commands.options.serving import add_serving, serve


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs view`."""
    parser.description = (
        "Opens a page in the browser that shows what eyes before the panel see of a photo or of a scene of 3D "
        "Gaussians, with sliders for depth, and the panel's own page for the native picture. Ctrl-C ends it."
    )
    add = parser.add_argument
    add("input", type=Path, metavar="INPUT", help="a photo or a file of Gaussians, as `encode` takes it")
    add_panel(add, "for framing, and for the eye on the page")
    add_camera(add)
    add("--mask", type=Path, metavar="IMAGE", help="cut-out of a photo, of its size: bright or opaque on the object")
    add("--remove-background", action="store_true", help="cut the object out of a photo with rembg, as in `encode`")
    add("--checkpoint", type=Path, metavar="FILE", help="weights of the network, .safetensors (default: those inside)")
    add_depth(add)
    add_look(add)
    add_skip_invalid(add)
    add_antialiased(add)
    add_background(add)
    add("--device", choices=DEVICES, default="auto", help="where it is drawn (default auto: cuda where there is a GPU)")
    add_serving(add)


def run(args: argparse.Namespace) -> None:
    """Serves the page of args.input until Ctrl-C. Raises InputError."""
    watch = Stopwatch(args.began)
    check_scene_options(args)
    panel = load_panel(args)
    device = choose_device(args.device)
    given = read_given(args, panel)

    import torch

    from lightfield_gs.show.page.exports import exports
    from lightfield_gs.show.page.routes import steering_routes
    from lightfield_gs.show.page.stage import Stage

    watch.lap("start")
    with torch.no_grad():
        gaussians, file = load_scene(args, device, watch, panel)
        drawn_so = settle_drawing(args, file)
        rig, said = choose_rig(given, args, panel, gaussians, file)
        rig, look = apply_look(args, rig, panel, gaussians)
    stage = Stage(gaussians, panel, rig, args.background, args.antialiased, args.input.name)
    print(f"{args.input}: {gaussians.count} Gaussians on panel {panel.name}, drawn on {device}")
    print("\n".join([watch.line(), *drawn_so, *said, *look]))
    serve(args, steering_routes(stage, exports(stage)), "/")
