"""`lightfield-gs video`: a scene with moving cameras, or pictures in a row, to frames for a panel."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path

from lightfield_gs.app.panel import load_panel
from lightfield_gs.app.provenance import software
from lightfield_gs.app.scene import files_read
from lightfield_gs.app.video import Result, checked_result
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import DEVICES, QUALITY_NAMES, VIEWS
from lightfield_gs.base.stopwatch import Stopwatch
from lightfield_gs.commands.options.cameras import add_camera, add_depth_report, add_look
from lightfield_gs.commands.options.panel import add_panel
from lightfield_gs.commands.options.parser import threads
from lightfield_gs.commands.options.scene import add_antialiased, add_background, add_scene, add_view_filter
from lightfield_gs.commands.options.video import add_motion, add_result
from lightfield_gs.commands.quilt import framed_for
from lightfield_gs.io.atomic import check_outputs
from lightfield_gs.panels.panel import Panel


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of `lightfield-gs video`."""
    parser.description = (
        "Frames for a slanted-lenticular panel: of a scene that the cameras go round, or of pictures in a row. Where "
        "it is stopped, a folder of frames is taken up again by the same command."
    )
    add = parser.add_argument
    add(
        "input",
        type=Path,
        metavar="INPUT",
        help="a scene or a photo, as `encode` takes it; or a sequence: a folder of photos or of RGB-D pictures, or a "
        "video of either",
    )
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="PATH",
        help="a folder for PNG files, or .mp4, .mkv or .mov (pip install 'lightfield-gs[video]')",
    )
    add_motion(add)
    add_result(add)
    add_panel(add, "for framing")
    add_camera(add)
    add_look(add)
    add_depth_report(add)
    cut_outs = "cut-out of a photo; of a sequence, a folder or a video of cut-outs"
    add_scene(add, "cut the object out of photos with rembg, as `encode` does", cut_outs, "PATH")
    add("--device", choices=DEVICES, default="auto", help="where network and rasterizer run (default auto)")
    add("--views", choices=VIEWS, default="integer", help="of native pictures, as `encode` has it (default integer)")
    add("--quality", choices=QUALITY_NAMES, default="exact", help="less time for more error, of native pictures")
    add_antialiased(add)
    add_view_filter(add)
    add_background(add)
    add("--threads", type=threads, metavar="N", help="number of threads that draw (default: all cores)")


def run(args: argparse.Namespace) -> None:
    """Makes args.output of args.input. Raises InputError."""
    watch = Stopwatch(args.began)
    panel = load_panel(args)
    result = checked_result(args, panel)
    if result.layout is not None:
        panel = framed_for(result.layout, panel)
    check_outputs((result.path,), files_read(args))
    device = choose_device(args.device)
    if args.bridge is not None:
        from lightfield_gs.show.bridge import cast, check_bridge

        check_bridge(args.bridge)
    import torch

    from lightfield_gs.app.shots import sequence_shots, still_shots
    from lightfield_gs.video.rendering import make_video
    from lightfield_gs.video.sequence import is_sequence

    if args.threads is not None:
        torch.set_num_threads(args.threads)
    watch.lap("start")
    with torch.inference_mode(), ExitStack() as stack:
        shots = (sequence_shots if is_sequence(args.input) else still_shots)(args, panel, device, watch, stack)
        draw = _draw(args, panel, result, shots.fps, shots.is_one_scene)
        sink = _sink(args, panel, result, shots, draw.size_px)
        there = shots.count - len(sink.missing)
        made = make_video(shots.take, draw, sink, shots.count, shown=True)
        watch.lap("frames")
    width, height = draw.size_px
    kept = f", of which {there} were there" if there else ""
    rate = f"{float(shots.fps):g} a second"
    print(f"{result.path}: {shots.count} frames of {width} x {height}, {_words(result)}{kept}, {rate}")
    print(made.words())
    print(watch.line())
    print("".join(f"{line}\n" for line in shots.messages), end="")
    if args.bridge is not None and result.layout is not None:
        cast(result.path, result.layout.columns, result.layout.rows, result.layout.aspect, url=args.bridge)
        print(f"{result.path}: shown by Looking Glass Bridge")


def _words(result: Result) -> str:
    kind = {"native": "native", "quilt": "quilt", "2d": "one eye"}[result.kind]
    if result.layout is not None:
        kind += f" of {result.layout.columns} x {result.layout.rows} views"
    return f"{kind}, {result.codec or 'PNG'}"


def _draw(args: argparse.Namespace, panel: Panel, result: Result, fps: Fraction, is_one_scene: bool):
    """What draws a frame; args: with background and anti-aliasing settled."""
    from lightfield_gs.video.rendering import Drawing, EyeFrames, NativeFrames, QuiltFrames

    drawing = Drawing(args.views, args.background, args.quality, args.antialiased, args.view_filter)
    if result.kind != "native" and (args.views, args.quality) != ("integer", "exact"):
        raise InputError(f"--views and --quality are of native pictures, not of --kind {result.kind}; leave them out")
    if result.layout is not None:
        return QuiltFrames(panel, drawing, result.layout)
    if result.kind == "2d":
        return EyeFrames(panel, drawing, None if args.sway is None else float(args.sway * fps))
    return NativeFrames(panel, drawing, is_one_scene)


def _sink(args: argparse.Namespace, panel: Panel, result: Result, shots, size_px: tuple[int, int]):
    """The files that the frames go to, of which some may be there."""
    if result.codec is not None:
        from lightfield_gs.video.video_file import VideoFile

        return VideoFile(result.path, shots.count, size_px, shots.fps, result.codec, args.crf)
    import json

    from lightfield_gs.video.frame_folder import FrameFolder

    maker = software()
    native = {"panel": json.dumps(panel.to_dict())} if result.kind == "native" else {}

    def metadata(number: int) -> dict[str, str]:
        rig = shots.rig_of_file(number)
        more = {} if rig is None else {"rig": json.dumps(rig.to_dict())}
        return {"software": maker, "input": args.input.name, **native, **more, "frame": str(number)}

    job = {
        "software": maker,
        "kind": result.kind,
        "size": list(size_px),
        "quilt": None if result.layout is None else asdict(result.layout),
        "panel": panel.to_dict(),
        "views": args.views,
        "quality": args.quality,
        "background": list(args.background),
        "antialiased": args.antialiased,
        "view_filter": args.view_filter,
        "compression": args.compression,
        "sway": args.sway,
        "frames": shots.count,
        "fps": str(shots.fps),
        **shots.job,
    }
    return FrameFolder(
        result.path,
        shots.count,
        job,
        fps=float(shots.fps),
        metadata=metadata,
        compression=args.compression,
        writers=args.writers,
        overwrite=args.overwrite,
    )
