"""`lightfield-gs prune`: a scene without the Gaussians that hardly show on a panel."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

from lightfield_gs.app.cameras import apply_look, read_camera, scene_comments
from lightfield_gs.app.options import (
    CameraOptions,
    LookOptions,
    PanelOptions,
    RenderOptions,
    SceneOptions,
    files_read,
    rig_beside,
)
from lightfield_gs.app.panel import load_panel, panel_words
from lightfield_gs.app.scene import LoadedScene, check_scene_path, choose_rig, read_noted, say_origin, settle_render
from lightfield_gs.base.cli_messages import Stopwatch, say, say_next
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Device
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_output_path, check_outputs
from lightfield_gs.panels.stored_rigs import write_rig_beside


@dataclass(frozen=True, slots=True)
class PruneOptions:
    """A scene that loses what hardly shows on a panel.

    Attributes:
        output: the scene without it.
        scene, panel, camera, look, render: see there.
        contribution_cut: mean error that colours of 0..1 may have.
        save_rig: file for the rig.
        device: where the scene is drawn.
        stats: whether to print the times of the stages.
    """

    output: Path
    scene: SceneOptions
    panel: PanelOptions
    camera: CameraOptions
    look: LookOptions
    render: RenderOptions
    contribution_cut: float
    save_rig: Path | None = None
    device: Device = "auto"
    stats: bool = False


def run(args: argparse.Namespace) -> None:
    """Prune args.input into args.output. Raises InputError."""
    _prune(read_options(PruneOptions, args), Stopwatch(args.began))


def _prune(options: PruneOptions, watch: Stopwatch) -> None:
    source, output = options.scene.input, options.output
    check_scene_path(output)
    if options.save_rig is not None:
        check_output_path(options.save_rig)
    beside = rig_beside(output)
    outputs = (output, options.save_rig, None if beside == options.save_rig else beside)
    check_outputs(outputs, files_read(options.scene, options.camera, options.panel))
    panel = load_panel(options.panel)
    device = choose_device(options.device)

    from lightfield_gs.encoding.pruning import prune

    choice = read_camera(options.camera, panel)
    watch.lap("start")
    file = read_noted(source, options.scene.skip_invalid, options.scene.time, options.scene.lod)
    say_origin(source, file.gaussians)
    render, messages = settle_render(options.render, source, file)
    watch.lap("load")
    scene = LoadedScene(source, file.gaussians.to(device), render, file)
    chosen = choose_rig(choice, scene, panel)
    rig, looks = apply_look(options.look, chosen.rig, panel, scene.gaussians)
    messages += [*chosen.messages, *looks]
    rig_of_file = scene.in_file(rig)
    kept = prune(scene.gaussians, panel, rig, options.contribution_cut, render.antialiased, render.view_filter)
    watch.lap("prune")
    if kept.count == 0:
        raise InputError(
            f"{output}: nothing would be left of {scene.gaussians.count} Gaussians; give a smaller "
            "--contribution-cut or another --rig"
        )
    comments = scene_comments(options.camera.up, render.antialiased, panel, file, rig_of_file)
    kept.to("cpu").save(output, comments)
    if options.save_rig is not None:
        rig_of_file.to_yaml(options.save_rig, panel)
    watch.lap("write")
    print(
        f"{output}: {kept.count} of {scene.gaussians.count} Gaussians, the others within "
        f"{options.contribution_cut:g} of the light of {panel.width_px} x {panel.height_px}, {panel.views} views"
    )
    watch.say_if(options.stats)
    if beside is not None:
        own, _ = settle_render(replace(options.render, background=None), source, file)
        write_rig_beside(output, rig_of_file, panel, own.background, render.antialiased)
        messages.append(f"{output}: in the axes of {source}; the framing it was pruned for is in {beside}")
    else:
        messages.append(f"{output}: in the axes of {source}, with the framing it was pruned for: encode takes it")
    say(*messages)
    say_next("encode", output, "-o", output.with_suffix(".png"), *panel_words(options.panel.panel))
