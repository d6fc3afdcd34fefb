"""`lightfield-gs view`: a page in the browser that shows a scene as the panel would, and steers it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from lightfield_gs.app.cameras import read_camera
from lightfield_gs.app.options import CameraOptions, LookOptions, PanelOptions, RenderOptions, SceneOptions
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.scene import check_scene_options, load_framed
from lightfield_gs.base.cli_messages import Stopwatch, say
from lightfield_gs.commands.options.panel import add_camera, add_drawing_device, add_look, add_panel, add_rendering
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.options.scene import add_scene
from lightfield_gs.commands.options.serving import ServingOptions, add_serving, serve
from lightfield_gs.webgpu.devices import choose_drawing_device

_MANY_FRAMES = 100  # for the choice of a device, whose start they outweigh


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """A scene that a page shows.

    Attributes:
        device: Device that draws the scene.
    """

    scene: SceneOptions
    panel: PanelOptions
    camera: CameraOptions
    look: LookOptions
    render: RenderOptions
    serving: ServingOptions
    device: str = "auto"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `lightfield-gs view`."""
    parser.description = (
        "Open a page in the browser with the picture that an eye before the panel sees of a photo or a "
        "scene of 3D Gaussians, with sliders for depth, and the panel's own page for the native picture. "
        "Ctrl-C ends it."
    )
    add = parser.add_argument
    add("input", type=Path, metavar="INPUT", help="a photo or a file of Gaussians, as `encode` takes it")
    add_panel(add, "for framing, and for the eye on the page")
    add_camera(add)
    add_look(add)
    add_scene(add, "cut the object out of a photo with rembg, as in `encode`")
    add_rendering(add)
    add_drawing_device(add)
    add_serving(add)


def run(args: argparse.Namespace) -> None:
    """Serve the page of args.input until Ctrl-C. Raises InputError."""
    _view(read_options(ViewOptions, args), Stopwatch(args.began))


def _view(options: ViewOptions, watch: Stopwatch) -> None:
    check_scene_options(options.scene, options.camera)
    panel = load_panel(options.panel)
    pixels = panel.width_px * panel.height_px
    device, webgpu, decisions = choose_drawing_device(options.device, pixels, _MANY_FRAMES)
    choice = read_camera(options.camera, panel)

    import torch

    from lightfield_gs.show.page.routes import exports, steering_routes
    from lightfield_gs.show.page.stage import Stage

    watch.lap("start")
    with torch.no_grad():
        framed = load_framed(options.scene, choice, options.render, options.look, panel, device, watch)
    scene, render, path = framed.scene, framed.scene.render, options.scene.input
    drawn_as = render.background, render.antialiased, path.name, render.view_filter
    stage = Stage(scene.gaussians, panel, framed.rig, *drawn_as, webgpu)
    print(f"{path}: {scene.gaussians.count} Gaussians on panel {panel.name}, drawn on {webgpu or device}")
    say(watch.line(), *decisions, *framed.messages)
    serve(options.serving, steering_routes(stage, exports(stage)), "/")
