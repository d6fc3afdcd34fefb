"""How many frames of a turntable come in a second, with and without the files that they go to."""

from __future__ import annotations

import argparse
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.device import to_numpy
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.bench.report import aligned
from lightfield_gs.bench.scenes import benchmark_rig, load_scene
from lightfield_gs.commands.options.parser import whole
from lightfield_gs.io.atomic import scratch_folder
from lightfield_gs.panels.panel import Panel
from lightfield_gs.video.camera_path import turntable
from lightfield_gs.video.frame_folder import FrameFolder
from lightfield_gs.video.rendering import FrameOptions, NativeRenderer, Sink, render_frames
from lightfield_gs.video.video_file import VideoFile

SINKS = ("none", "png", "h264-rgb", "ffv1")
FRAMES = {"cpu": 10, "cuda": 300}
_FPS = Fraction(30)


class NullSink(nullcontext):
    """Discards frames, to measure rendering alone."""

    def __init__(self, count: int):
        self.missing = list(range(count))

    def __enter__(self) -> NullSink:
        return self

    def fetch(self, image: Tensor) -> np.ndarray:
        """Copy the frame to the host."""
        return to_numpy(image)

    def put(self, number: int, image: np.ndarray) -> None:
        """Discard it."""


@torch.inference_mode()
def rows(scene: str, panel: Panel, frames: int, sinks: tuple[str, ...], device: str) -> list[dict[str, Any]]:
    """A row for each of `sinks`, of SINKS: frames a second and where the time went, s; bytes of a frame's file.

    Raises InputError.
    """
    gaussians = load_scene(scene).to(device)
    rigs = turntable(benchmark_rig(scene, gaussians, panel, None), panel, frames)
    size = panel.width_px, panel.height_px
    found = []
    for name in sinks:
        options.progress(f"{frames} frames to {name}")
        draw = NativeRenderer(panel, FrameOptions(), is_one_scene=True)
        for rig in rigs[:2]:  # memory comes, and on CUDA kernels load
            draw(gaussians, rig, 0)
        with ExitStack() as stack:
            folder = stack.enter_context(scratch_folder())
            made = render_frames(
                lambda numbers: ((number, gaussians, rigs[number]) for number in numbers),
                draw,
                _sink(name, folder, frames, size),
                frames,
            )
            written = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        found.append(
            {
                "scene": scene,
                "gaussians": gaussians.count,
                "panel": panel.name,
                "sink": name,
                "frames_per_second": made.frames / made.total_s,
                "bytes_per_frame": written / frames,
                **asdict(made),
            }
        )
    return found


def _sink(name: str, folder: Path, frames: int, size_px: tuple[int, int]) -> Sink:
    if name == "none":
        return NullSink(frames)
    if name == "png":
        return FrameFolder(folder / "frames", frames, {}, fps=float(_FPS))
    return VideoFile(folder / "video.mkv", frames, size_px, _FPS, "ffv1" if name == "ffv1" else "h264-rgb")


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as text, a line each."""
    head = ("scene", "panel", "frames", "files", "frames/s", "draw s", "wait s", "finish s", "total s", "MB a frame")
    lines = [
        (
            row["scene"],
            row["panel"],
            str(row["frames"]),
            row["sink"],
            f"{row['frames_per_second']:.3g}",
            *(f"{row[key]:.2f}" for key in ("draw_s", "wait_s", "finish_s", "total_s")),
            f"{row['bytes_per_frame'] / 1e6:.3g}",
        )
        for row in rows
    ]
    return "\n".join(aligned([head, *lines]))


SCENE = "sheet:128"


@dataclass(frozen=True, kw_only=True)
class Options(options.PanelOptions):
    """The options of the benchmark.

    Attributes:
        scene: name or file of the scene.
        files: kinds of files, with commas.
        frames: number of frames. None: that of FRAMES.
    """

    scene: str = SCENE
    files: str = "none,png"
    frames: int | None = None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("--scene", default=SCENE, help="sheet:S, cloud:N or a .ply (default: %(default)s)")
    parser.add_argument(
        "--files",
        default="none,png",
        help=f"where frames go, with commas: {', '.join(SINKS)}; the last two by PyAV (default: %(default)s)",
    )
    parser.add_argument(
        "--frames",
        type=whole(1, 100_000),
        metavar="N",
        help=f"of the turntable (default: {FRAMES['cuda']}, on the CPU {FRAMES['cpu']})",
    )
    options.add_panel(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """A row of each kind of files, and their text."""
    options.check_scenes([given.scene])
    sinks = tuple(given.files.split(","))
    if not set(sinks) <= set(SINKS):
        raise InputError(f"files=: expected some of {', '.join(SINKS)}, with commas, got {given.files!r}")
    torch.set_num_threads(given.thread_count or torch.get_num_threads())
    frames = given.frames or FRAMES[given.device]
    found = rows(given.scene, given.load_panel(), frames, sinks, given.device)
    return {"rows": found}, table(found)
