"""`lightfield-gs view`: a page in the browser that shows a scene as the panel would, and steers it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field

from lightfield_gs.app.cameras import read_camera
from lightfield_gs.app.options import (
    CameraOptions,
    LookOptions,
    PanelOptions,
    RenderOptions,
    SceneOptions,
    StereoOptions,
)
from lightfield_gs.app.scene import check_scene_options, load_framed
from lightfield_gs.app.stereo import panel_of, refuse_files
from lightfield_gs.base.cli_messages import Stopwatch, say
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.commands.options.serving import ServingOptions, serve
from lightfield_gs.webgpu.devices import choose_drawing_device

_MANY_FRAMES = 100  # for the choice of a device, whose start they outweigh


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """A scene that a page shows.

    Attributes:
        device: Device that draws the scene.
        stereo: for a screen of two eyes, in place of a panel.
        stats: whether to print the times of the stages.
    """

    scene: SceneOptions
    panel: PanelOptions
    camera: CameraOptions
    look: LookOptions
    render: RenderOptions
    serving: ServingOptions
    device: str = "auto"
    stereo: StereoOptions = field(default_factory=StereoOptions)
    stats: bool = False


def run(args: argparse.Namespace) -> None:
    """Serve the page of args.input until Ctrl-C. Raises InputError."""
    _view(read_options(ViewOptions, args), Stopwatch(args.began))


def _view(options: ViewOptions, watch: Stopwatch) -> None:
    check_scene_options(options.scene, options.camera)
    refuse_files(options.stereo.stereo, "a screen")
    panel, screen = panel_of(options.stereo, options.panel)
    pixels = panel.width_px * panel.height_px
    device, webgpu, decisions = choose_drawing_device(options.device, pixels, _MANY_FRAMES)
    choice = read_camera(options.camera, panel)

    import torch

    from lightfield_gs.show.page.routes import exports, steering_routes
    from lightfield_gs.show.page.stage import Stage
    from lightfield_gs.show.page.stereo_stage import StereoStage

    watch.lap("start")
    with torch.no_grad():
        framed = load_framed(options.scene, choice, options.render, options.look, panel, device, watch)
    scene, render, path = framed.scene, framed.scene.render, options.scene.input
    drawn_as = render.background, render.antialiased, path.name, render.view_filter
    if (layout := options.stereo.stereo) is None:
        stage, where = Stage(scene.gaussians, panel, framed.rig, *drawn_as, webgpu), f"panel {panel.name}"
    else:
        stage = StereoStage(scene.gaussians, panel, framed.rig, layout, *drawn_as, webgpu)
        where = f"a screen of two eyes, {layout}"
    print(f"{path}: {scene.gaussians.count} Gaussians on {where}, drawn on {webgpu or device}")
    watch.say_if(options.stats)
    say(*decisions, *screen, *framed.messages)
    serve(options.serving, steering_routes(stage, exports(stage)), "/")
