"""`lightfield-gs video`: a scene with moving cameras, or pictures in a row, to frames for a panel."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import replace

from lightfield_gs.app.panel import panel_of_views
from lightfield_gs.app.stereo import panel_of, refuse_panel, refuse_stereo
from lightfield_gs.app.video import VideoOptions, for_preset, frame_drawer, frame_sink, video_target
from lightfield_gs.base.cli_messages import Stopwatch, say, say_next
from lightfield_gs.base.options import PRESET_SIZES
from lightfield_gs.commands.options.parser import read_options
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.stereo_screen import StereoScreen
from lightfield_gs.webgpu.devices import choose_drawing_device

_MANY_FRAMES = 100  # for the choice of a device, whose start they outweigh


def run(args: argparse.Namespace) -> None:
    """Make args.output of args.input. Raises InputError."""
    make_frames(read_options(VideoOptions, args), Stopwatch(args.began))


def _panel(options: VideoOptions) -> tuple[Panel, list[str]]:
    """Return the panel that frames the scene, the display's or that of a screen of two eyes or of one; and a line."""
    if options.preset is not None:
        refuse_panel(options.panel.panel)
        return StereoScreen(*PRESET_SIZES[options.preset]).panel(), []
    return panel_of(options.stereo, options.panel)


def make_frames(options: VideoOptions, watch: Stopwatch) -> None:
    """Make the frames of a video, and print a summary. Raises InputError."""
    refuse_stereo(options.stereo)
    options = for_preset(options)
    panel, screen = _panel(options)
    target = video_target(options, panel)
    if target.layout is not None:
        panel = panel_of_views(target.layout, panel)
    check_outputs((target.path,), options.inputs())
    device, webgpu, decisions = choose_drawing_device(options.device, panel.width_px * panel.height_px, _MANY_FRAMES)
    options = replace(options, device=webgpu or device)
    if options.bridge is not None:
        from lightfield_gs.show.bridge import cast, check_bridge

        check_bridge(options.bridge)
    import torch

    from lightfield_gs.app.scene_film import scene_film_shots
    from lightfield_gs.app.shots import sequence_shots, still_shots
    from lightfield_gs.video.rendering import render_frames
    from lightfield_gs.video.scene_sequence import find_scene_sequence
    from lightfield_gs.video.sequence import is_sequence

    if options.threads is not None:
        torch.set_num_threads(options.threads)
    watch.lap("start")
    with torch.inference_mode(), ExitStack() as stack:
        source = options.scene.input
        take_shots = sequence_shots if is_sequence(source) else still_shots
        take_shots = scene_film_shots if find_scene_sequence(source) else take_shots
        shots = take_shots(options, panel, device, watch, stack)
        drawer = frame_drawer(options, panel, target, shots)
        sink = frame_sink(options, panel, target, shots, drawer.size_px)
        there = shots.count - len(sink.missing)
        made = render_frames(shots.take, drawer, sink, shots.count, shown=True)
        watch.lap("frames")
    width, height = drawer.size_px
    kept = f", of which {there} were there" if there else ""
    rate = f"{float(shots.fps):g} a second"
    print(f"{target.path}: {shots.count} frames of {width} x {height}, {target.words()}{kept}, {rate}")
    if options.stats:
        print(made.words())
    watch.say_if(options.stats)
    say(*decisions, *screen, *shots.messages, *shots.closing())
    if options.bridge is not None and target.layout is not None:
        layout = target.layout
        cast(target.path, layout.columns, layout.rows, layout.aspect, url=options.bridge)
        print(f"{target.path}: shown by Looking Glass Bridge")
    elif target.kind != "2d" and options.stereo.stereo != "anaglyph":  # as `show` takes them
        say_next("show", target.path)
