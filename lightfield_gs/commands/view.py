"""`lightfield-gs view`: a page in the browser that shows a scene as the panel would, and steers it."""

from __future__ import annotations

import argparse
from pathlib import Path

from lightfield_gs.app.cameras import read_given
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.scene import check_scene_options, load_framed
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.options import DEVICES
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.cameras import add_camera, add_look
from lightfield_gs.commands.options.panel import add_panel
from lightfield_gs.commands.options.scene import add_antialiased, add_background, add_scene, add_view_filter
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
    add_look(add)
    add_scene(add, "cut the object out of a photo with rembg, as in `encode`")
    add_antialiased(add)
    add_view_filter(add)
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
        framed = load_framed(args, panel, given, device, watch)
    drawn_as = args.background, args.antialiased, args.input.name, args.view_filter
    stage = Stage(framed.gaussians, panel, framed.rig, *drawn_as)
    print(f"{args.input}: {framed.gaussians.count} Gaussians on panel {panel.name}, drawn on {device}")
    print("\n".join([watch.line(), *framed.messages]))
    serve(args, steering_routes(stage, exports(stage)), "/")
