"""Measure frames by WebGPU, tiling by tiling and stage by stage, beside CUDA or the CPU in the same run.

Times of stages are the device's timestamps, medians of a few frames; `frame` is from the first to the last. The wall
time is that of a call of the frame with the copy of the image to the host. Bytes are compared with the CPU's, since the
polynomials of CUDA err too; beside CUDA the distances of both from each other and from the CPU are told.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass
from typing import Any

import torch

from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.bench.report import aligned, in_ms
from lightfield_gs.bench.scenes import benchmark_rig, load_scene
from lightfield_gs.bench.timing import timed
from lightfield_gs.encoding.encoder import Encoder
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, lenticular_camera
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.quality import EXACT
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.webgpu.adapters import adapter_at
from lightfield_gs.webgpu.frames import Frames
from lightfield_gs.webgpu.parameters import tilings
from lightfield_gs.webgpu.pipelines import Clock

SCENES = ("sheet:128", "sheet:512", "cloud:262144")
_FRAMES = 5  # that count; one before them compiles


@dataclass(frozen=True, kw_only=True)
class Options(options.SceneOptions):
    """The options of the benchmark.

    Attributes:
        adapter: place of the adapter in `info --devices`.
        tilings: whether every tiling is measured, not only the one that a frame chooses.
    """

    adapter: int = 0
    tilings: bool = False


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark; --device is what it is compared with."""
    options.add_scene(parser, SCENES)
    options.add_cone(parser)
    parser.add_argument("--sh-degree", help="degrees of synthetic scenes, 0..3; several with commas (default: 0)")
    options.add_panel(parser)
    parser.add_argument("--adapter", type=int, default=0, metavar="N", help="of `info --devices` (default: 0)")
    parser.add_argument("--tilings", action="store_true", help="measure every tiling, not only the cheapest")
    options.add_repeats(parser)
    options.add_machine(parser)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """Return the rows and their table. Raises InputError."""
    scenes = given.scene.split(",") if given.scene else list(SCENES)
    degrees = [int(part) for part in given.sh_degree.split(",")] if given.sh_degree else [None]
    options.check_scenes(scenes, degrees)
    panel, adapter = given.load_panel(), adapter_at(given.adapter)
    frames = Frames(adapter.open(), adapter.limits)
    if "timestamp-query" not in frames.device.features:
        raise InputError(f"bench webgpu: {adapter} has no timestamps; time `encode --device webgpu` in its place")
    frames.clock = Clock(frames.device)
    rows = []
    for scene in scenes:
        for degree in degrees:
            gaussians = load_scene(scene, degree)
            for cone in options.cones(given.cone):
                rig = benchmark_rig(scene, gaussians, panel, cone)
                facts = {"scene": scene, "degree": degree or 0, "cone_deg": rig.cone_deg}
                rows += [{**facts, **row} for row in _rows(frames, gaussians, panel, rig, given)]
    result = {"adapter": str(adapter), "driver": adapter.driver, "panel": panel.name, "rows": rows}
    return result, f"{adapter}, {adapter.driver}\n{_table(rows, given.device)}"


def _rows(frames: Frames, gaussians: Gaussians, panel: Panel, rig: Rig, given: Options) -> list[dict[str, Any]]:
    """Return a row for each tiling of a scene, the chosen one first."""
    expected, beside = timed(_peer(gaussians, panel, rig, given.device), given.device == "cuda", given.repeats)
    camera = lenticular_camera(panel, rig)
    job = DirectRender(gaussians.fields().values(), torch.ones(3), camera)
    by_cuda = expected.cpu() if given.device == "cuda" else None
    on_cpu = expected if by_cuda is None else job.draw(True)
    rows = []
    for tiling in (None, *(tilings(camera.lens) if given.tilings else ())):
        frames.tiling = tiling
        row = _measured(frames, job, given.repeats or _FRAMES)
        image = row.pop("image")
        row["most_apart"] = _most_apart(image, on_cpu)
        if by_cuda is not None:
            row["most_apart_from_cuda"], row["cuda_most_apart"] = (_most_apart(by_cuda, i) for i in (image, on_cpu))
        row[f"{given.device}_ms"] = statistics.median(beside)
        rows.append(row)
    frames.tiling = None
    return rows


def _most_apart(image: torch.Tensor, other: torch.Tensor) -> int:
    """Return the largest difference of two images, of 255."""
    return int((image.int() - other.int()).abs().max())


def _peer(gaussians: Gaussians, panel: Panel, rig: Rig, device: str) -> Any:
    """Return a call that draws the same frame on CUDA or on the CPU."""
    encoder, there = Encoder(panel, rig, versioned=True), gaussians.to(device)

    def draw() -> torch.Tensor:
        encoder.forget()
        return encoder(there)

    def replay() -> torch.Tensor:
        there.means.add_(0)  # counts as a change, so that the frame is drawn again
        return encoder(there)

    return replay if device == "cuda" else draw


def _measured(frames: Frames, job: DirectRender, repeats: int) -> dict[str, Any]:
    """Return the image of a frame, its times and counts."""
    began = time.perf_counter()
    frames.draw(job, True, EXACT, Stats(), None)
    first_ms = 1e3 * (time.perf_counter() - began)
    assert frames.clock is not None
    frames.clock.stages_ms()
    stages, walls = [], []
    for _ in range(repeats):
        stats, began = Stats(), time.perf_counter()
        image = frames.draw(job, True, EXACT, stats, None)
        walls.append(1e3 * (time.perf_counter() - began))
        stages.append(frames.clock.stages_ms())
    return {
        "image": image,
        "kernel": stats.kernel,
        "stages_ms": {name: statistics.median(one.get(name, 0.0) for one in stages) for name in stages[-1]},
        "wall_ms": statistics.median(walls),
        "first_ms": first_ms,
        "pairs": stats.intersections,
        "work_bytes": stats.work_bytes,
    }


def _table(rows: list[dict[str, Any]], device: str) -> str:
    """Return the rows for people; `stages` is the sum of the stages, for the host waits between some of them.

    `apart` is from the CPU; beside CUDA, then from CUDA, and CUDA from the CPU.
    """
    head = ("scene", "SH", "cone", "kernel", "stages", "composite", "wall", device, "apart", "pairs", "MB")
    lines: list[tuple[str, ...]] = [head]
    for row in rows:
        stages = row["stages_ms"]
        apart = [row[key] for key in ("most_apart", "most_apart_from_cuda", "cuda_most_apart") if key in row]
        busy = sum(ms for name, ms in stages.items() if name != "frame")
        lines.append(
            (
                *(row["scene"], str(row["degree"]), f"{row['cone_deg']:.1f}", row["kernel"]),
                *(in_ms(ms) for ms in (busy, stages["composite"], row["wall_ms"], row[f"{device}_ms"])),
                *(" ".join(map(str, apart)), str(row["pairs"]), f"{row['work_bytes'] / 1e6:.0f}"),
            )
        )
    return "\n".join(aligned(lines))
