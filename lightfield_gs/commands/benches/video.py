"""`lightfield-gs bench video`: frames a second of a turntable, with and without writing them."""

from __future__ import annotations

import argparse
from typing import Any

import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import video
from lightfield_gs.commands.options import bench as options
from lightfield_gs.commands.options.parser import whole

SCENE = "sheet:128"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its arguments."""
    parser.add_argument("--scene", default=SCENE, help="sheet:S, cloud:N or a .ply (default: %(default)s)")
    parser.add_argument(
        "--files",
        default="none,png",
        help=f"where frames go, with commas: {', '.join(video.SINKS)}; the last two by PyAV (default: %(default)s)",
    )
    parser.add_argument(
        "--frames",
        type=whole(1, 100_000),
        metavar="N",
        help=f"of the turntable (default: {video.FRAMES['cuda']}, on the CPU {video.FRAMES['cpu']})",
    )
    options.add_panel(parser)
    options.add_machine(parser)


def rows(args: argparse.Namespace) -> tuple[dict[str, Any], str]:
    """A row of each kind of files, and their text."""
    options.check_scenes([args.scene])
    sinks = tuple(args.files.split(","))
    if not set(sinks) <= set(video.SINKS):
        raise InputError(f"--files: expected some of {', '.join(video.SINKS)}, with commas, got {args.files!r}")
    torch.set_num_threads(options.one_thread_count(args.threads) or torch.get_num_threads())
    frames = args.frames or video.FRAMES[args.device]
    found = video.rows(args.scene, options.panel_of(args), frames, sinks, args.device, options.progress)
    return {"rows": found}, video.table(found)
