"""`lightfield-gs page`: a photo or a scene becomes one file to send, which a browser draws."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lightfield_gs.app.cameras import CameraChoice, read_camera
from lightfield_gs.app.options import CameraOptions, LookOptions, PanelOptions, RenderOptions, SceneOptions, files_read
from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.scene import FramedScene, check_scene_options, is_framed_here, load_framed
from lightfield_gs.base.cli_messages import Stopwatch, note, say
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Device
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_output_path, check_outputs

if TYPE_CHECKING:
    from lightfield_gs.panels.panel import Panel
    from lightfield_gs.panels.rig import Rig

_SUFFIXES = (".html", ".htm")
_LARGE_BYTES = 25 << 20  # that mail takes


@dataclass(frozen=True, slots=True)
class PageOptions:
    """A scene that becomes a page.

    Attributes:
        output: The page.
        title: Of the page; None: the input's name.
        device: Where the network runs, and where views for browsers without WebGPU are drawn.
        stats: Whether to print the times of the stages.
    """

    output: Path
    scene: SceneOptions
    panel: PanelOptions
    camera: CameraOptions
    look: LookOptions
    render: RenderOptions
    title: str | None = None
    device: Device = "auto"
    stats: bool = False


def run(args: argparse.Namespace) -> None:
    """Write the page of args.input. Raises InputError."""
    _write(read_options(PageOptions, args), Stopwatch(args.began))


def _write(options: PageOptions, watch: Stopwatch) -> None:
    check_output_path(options.output)
    check_outputs((options.output,), files_read(options.scene, options.camera, options.panel))
    if options.output.suffix.lower() not in _SUFFIXES:
        raise InputError(f"{options.output}: a page ends with {' or '.join(_SUFFIXES)}; give such a name")
    check_scene_options(options.scene, options.camera)
    panel = load_panel(options.panel)
    choice = read_camera(options.camera, panel)

    import torch

    from lightfield_gs.base.device import choose_device
    from lightfield_gs.show.scene_page.write import DrawnAs, write_scene_page

    device = choose_device(options.device)
    watch.lap("start")
    path = options.scene.input
    with torch.inference_mode():
        framed = load_framed(options.scene, choice, options.render, options.look, panel, device, watch, True)
        render = framed.scene.render
        page = write_scene_page(
            options.output,
            options.title or path.stem,
            framed.scene.gaussians,
            panel,
            framed.rig,
            DrawnAs(render.background, render.antialiased, render.view_filter),
            is_photo=framed.scene.photo is not None,
            is_for_panel=options.panel.panel is not None,
            upright_rig=_upright(options.look, choice, framed, panel),
        )
    watch.lap("page")
    size, each = page.size / 1e6, len(page.packed.data) / page.packed.count
    print(f"{options.output}: {size:.1f} MB, {page.packed.count} Gaussians of {each:.1f} bytes, panel {panel.name}")
    watch.say_if(options.stats)
    if page.size > _LARGE_BYTES:
        note(f"{options.output} is large for mail; `lightfield-gs prune` leaves out what the panel does not show")
    say(*framed.messages, f"{options.output}: open it in a browser, or send it")


def _upright(look: LookOptions, choice: CameraChoice, framed: FramedScene, panel: Panel) -> Rig | None:
    """Return cameras that frame a scene for upright screens; None where the options, or a file, frame it."""
    from lightfield_gs.panels.rig import Rig
    from lightfield_gs.show.scene_page.write import UPRIGHT_PX

    is_chosen = look.zoom is not None or look.pan is not None or not is_framed_here(choice, framed.scene)
    if is_chosen or framed.scene.photo is not None:
        return None
    width, height = UPRIGHT_PX
    upright = replace(panel, width_px=width, height_px=height)
    rig = Rig.frame(framed.scene.gaussians, upright, framed.rig.world_to_camera)
    return replace(rig, zero_depth=framed.rig.zero_depth, cone_deg=framed.rig.cone_deg)
