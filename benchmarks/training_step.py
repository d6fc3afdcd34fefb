"""The rasterizer's time in a training step: forward and backward of ordinary images, a batch of scenes at a time.

CPU: 8 objects before 4 cameras each, two layers of 128 x 128 Gaussians one behind the other, as the network draws them.
CUDA: 32 scenes of one such layer before 4 cameras each, image and alpha; Gaussians and gradients stay on the device.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from benchmarks import peers
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench import options
from lightfield_gs.bench.dense import OURS, Step
from lightfield_gs.bench.report import in_ms
from lightfield_gs.bench.scenes import ZERO_DEPTH, sheet
from lightfield_gs.bench.timing import timed_in_turn
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.images import render
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, from_tensors

OBJECTS, SCENES, VIEWS, SIZE_PX = 8, 32, 4, 128
CONE_DEG = 40.0
LAYER_DISTANCE = 0.3  # scene units


def objects() -> Gaussians:
    """The batch of objects, leaf tensors that ask for gradients."""
    layered = []
    for index in range(OBJECTS):
        front, back = sheet(SIZE_PX, 2 * index), sheet(SIZE_PX, 2 * index + 1)
        back.means *= 1 + LAYER_DISTANCE / back.means[:, 2:]
        layered.append([torch.cat(pair) for pair in zip(front.fields().values(), back.fields().values())])
    return from_tensors(torch.stack(field).requires_grad_() for field in zip(*layered))


def scenes() -> Gaussians:
    """The batch of scenes on the GPU, leaf tensors that ask for gradients."""
    sheets = [sheet(SIZE_PX, index).fields().values() for index in range(SCENES)]
    return from_tensors(torch.stack(field).cuda().requires_grad_() for field in zip(*sheets))


def cameras() -> Cameras:
    """VIEWS cameras over the cone."""
    # The sheet is twice as wide as high: half the focal length across makes it square.
    panel = Panel(SIZE_PX, SIZE_PX, VIEWS, line_number=3.0 * VIEWS, slant_tan=0.0, cone_deg=CONE_DEG)
    return Rig(np.eye(4), (SIZE_PX, 2 * SIZE_PX), (SIZE_PX / 2, SIZE_PX / 2), ZERO_DEPTH).cameras(panel)


def step_row(step: Step, cuda: bool, repeats: int | None) -> dict[str, Any]:
    """Return the setting, and medians of ms_forward, ms_backward and ms_total."""
    _, times = timed_in_turn((step.forward, step.backward), cuda, repeats)
    forward, backward, total = map(statistics.median, (*zip(*times), map(sum, times)))
    scenes = step.gaussians.means.shape[0]
    return {
        "objects": scenes,
        "views": VIEWS,
        "images": scenes * VIEWS,
        "size_px": SIZE_PX,
        "gaussians": step.gaussians.count,
        "ms_forward": forward,
        "ms_backward": backward,
        "ms_total": total,
    }


def cpu_rows(threads: list[int | None], repeats: int | None) -> list[dict[str, Any]]:
    """A row for each number of threads (None: those torch uses), after a step to warm up."""
    views = cameras()
    step = Step(objects(), lambda gaussians: render(gaussians, views).image, lambda image: image.square().mean())
    before, found = torch.get_num_threads(), []
    try:
        for count in threads:
            torch.set_num_threads(before if count is None else count)
            step.both()
            found.append(
                {"device": "cpu", "program": OURS, **step_row(step, False, repeats), "threads": torch.get_num_threads()}
            )
    finally:
        torch.set_num_threads(before)
    return found


def cuda_row(repeats: int | None) -> dict[str, Any]:
    """Ours on CUDA: image and alpha, and the gradients of their sum."""

    def images(gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
        image, alpha, *_ = render(gaussians, cameras, alpha=True)
        return image, cast(Tensor, alpha)

    return _cuda_row(OURS, images, repeats)


def gsplat_row(repeats: int | None) -> dict[str, Any]:
    """The same by gsplat. Raises InputError where there is none."""
    return _cuda_row(f"gsplat {peers.gsplat().__version__}", peers.gsplat_images, repeats)


def _cuda_row(
    program: str, draw: Callable[[Gaussians, Cameras], tuple[Tensor, Tensor]], repeats: int | None
) -> dict[str, Any]:
    views = cameras().to(device="cuda", dtype=torch.float32)

    def loss(outputs: tuple[Tensor, Tensor]) -> Tensor:
        return cast(Tensor, sum(map(torch.sum, outputs)))

    step = Step(scenes(), lambda gaussians: draw(gaussians, views), loss)
    return {"device": "cuda", "program": program, **step_row(step, True, repeats), "card": torch.cuda.get_device_name()}


def table(found: list[dict[str, Any]]) -> str:
    """The rows as text, a line each, and how ours compares with another program's."""
    lines = [_line(row) for row in found]
    for other in found:
        if other["program"] != OURS:
            both, forward = (other[key] / found[0][key] for key in ("ms_total", "ms_forward"))
            lines.append(
                f"ours is {both:.1f} times as fast as {other['program']} forward + backward, {forward:.1f} "
                "times forward"
            )
    return "\n".join(lines)


def _line(row: dict[str, Any]) -> str:
    where = f"{row['threads']} threads" if row["device"] == "cpu" else row["card"]
    forward, backward, both = (in_ms(row[f"ms_{part}"]) for part in ("forward", "backward", "total"))
    return (
        f"{row['program']}: {row['objects']} objects x {row['views']} views, {row['size_px']} px, "
        f"{row['gaussians']} Gaussians, {where}: forward {forward}, backward {backward}, both {both} ms"
    )


Options = options.BenchmarkOptions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    options.add_repeats(parser)
    options.add_machine(parser, several_threads=True)


def run(given: Options) -> tuple[dict[str, Any], str]:
    """A row for each number of threads, on CUDA one, and gsplat's where it can be had; and their text."""
    if given.device == "cpu":
        found = cpu_rows(options.thread_counts(given.threads), given.repeats)
    else:
        found = [cuda_row(given.repeats)]
        try:
            found.append(gsplat_row(given.repeats))
        except InputError as error:
            options.progress(f"no row of gsplat: {error}")
    return {"rows": found}, table(found)
