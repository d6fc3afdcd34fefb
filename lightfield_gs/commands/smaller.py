"""What `prune` and `simplify` have in common: they read a scene, make it smaller for a panel, and write it."""

from __future__ import annotations

from collections.abc import Callable
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
from lightfield_gs.io.atomic import check_output_path, check_outputs
from lightfield_gs.io.scenes.streamed_sog import is_streamed
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.stored_rigs import write_rig_beside
from lightfield_gs.scene.gaussians import Gaussians


@dataclass(frozen=True, slots=True)
class SmallerOptions:
    """A scene that becomes smaller for a panel.

    Attributes:
        output: the smaller scene.
        scene, panel, camera, look, render: see there.
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
    save_rig: Path | None = None
    device: Device = "auto"
    stats: bool = False


@dataclass(frozen=True)
class Smaller:
    """The scene that is left.

    Attributes:
        count: of its Gaussians.
        save: writes it to a path, with the comments of a header.
        words: returns a line on it, once it is written.
    """

    count: int
    save: Callable[[Path, list[str]], None]
    words: Callable[[], str]


def smaller(whole: Gaussians, kept: Gaussians, words: str, panel: Panel) -> Smaller:
    """Return fewer Gaussians of a scene; words: on their error on the panel."""
    size = f"{panel.width_px} x {panel.height_px}, {panel.views} views"
    told = f"{kept.count} of {whole.count} Gaussians, {words} of {size}"
    return Smaller(kept.count, kept.to("cpu").save, lambda: told)


# Makes a scene smaller, drawn on a panel from a rig
Reduction = Callable[[LoadedScene, Panel, Rig], Smaller]


def make_smaller(
    options: SmallerOptions, watch: Stopwatch, reduce: Reduction, check: Callable[[Path], object] = check_scene_path
) -> None:
    """Write a smaller scene, and say how much smaller it is.

    Args:
        options: what is asked for.
        watch: notes the times.
        reduce: makes the scene smaller.
        check: raises InputError where the output cannot be written.

    Raises:
        InputError: the options or the scene do not suit.
    """
    source, output = options.scene.input, options.output
    check(output)
    if options.save_rig is not None:
        check_output_path(options.save_rig)
    beside = rig_beside(output)
    outputs = (output, options.save_rig, None if beside == options.save_rig else beside)
    check_outputs(outputs, files_read(options.scene, options.camera, options.panel))
    panel = load_panel(options.panel)
    device = choose_device(options.device)
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
    kept = reduce(scene, panel, rig)
    watch.lap("reduce")
    if kept.count == 0:
        raise InputError(
            f"{output}: nothing would be left of {scene.gaussians.count} Gaussians; allow a smaller error, or give "
            "another --rig"
        )
    comments = scene_comments(options.camera.up, render.antialiased, panel, file, rig_of_file)
    kept.save(output, comments)
    if options.save_rig is not None:
        rig_of_file.to_yaml(options.save_rig, panel)
    watch.lap("write")
    print(f"{output}: {kept.words()}")
    watch.say_if(options.stats)
    if beside is not None:
        own, _ = settle_render(replace(options.render, background=None), source, file)
        write_rig_beside(output, rig_of_file, panel, own.background, render.antialiased)
        messages.append(f"{output}: in the axes of {source}; the framing it was made for is in {beside}")
    else:
        messages.append(f"{output}: in the axes of {source}, with the framing it was made for: encode takes it")
    say(*messages)
    shown = output.parent if is_streamed(output) else output
    say_next("encode", shown, "-o", shown.with_suffix(".png"), *panel_words(options.panel.panel))
