"""What the rasterizer costs in a training step: forward and backward of ordinary images, a batch of scenes at a time.

CPU: 8 objects before 4 cameras each, two layers of 128 x 128 Gaussians one behind the other, as the network draws them.
CUDA: 32 scenes of one such layer before 4 cameras each, image and alpha; Gaussians and gradients stay on the device.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.bench_scenes import ZERO_DEPTH, sheet
from lightfield_gs.cameras import Cameras
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.panel import Panel
from lightfield_gs.rendering import render
from lightfield_gs.rig import Rig

OBJECTS, SCENES, VIEWS, SIZE_PX = 8, 32, 4, 128
CONE_DEG = 40.0
LAYER_DISTANCE = 0.3  # scene units
_WARM_UP, _CUDA_RUNS = 5, 10  # steps on CUDA: before timing; timed per repeat


def objects() -> Gaussians:
    """The batch of objects, leaf tensors that ask for gradients."""
    layered = []
    for index in range(OBJECTS):
        front, back = sheet(SIZE_PX, 2 * index), sheet(SIZE_PX, 2 * index + 1)
        back.means *= 1 + LAYER_DISTANCE / back.means[:, 2:]
        layered.append([torch.cat(pair) for pair in zip(front.fields().values(), back.fields().values())])
    return Gaussians(*(torch.stack(field).requires_grad_() for field in zip(*layered)))


def scenes() -> Gaussians:
    """The batch of scenes on the GPU, leaf tensors that ask for gradients."""
    sheets = [sheet(SIZE_PX, index).fields().values() for index in range(SCENES)]
    return Gaussians(*(torch.stack(field).cuda().requires_grad_() for field in zip(*sheets)))


def cameras() -> Cameras:
    """VIEWS cameras over the cone."""
    # The sheet is twice as wide as high: half the focal length across makes it square.
    panel = Panel(SIZE_PX, SIZE_PX, VIEWS, line_number=3.0 * VIEWS, slant_tan=0.0, cone_deg=CONE_DEG)
    return Rig(np.eye(4), (SIZE_PX, 2 * SIZE_PX), (SIZE_PX / 2, SIZE_PX / 2), ZERO_DEPTH).cameras(panel)


def rows(threads: list[int | None], repeats: int) -> list[dict[str, Any]]:
    """On the CPU, a row for each number of threads (None: those torch uses); times are medians, after a run to warm up.
    """
    views, gaussians = cameras(), objects()
    before, found = torch.get_num_threads(), []
    try:
        for count in threads:
            torch.set_num_threads(before if count is None else count)
            times = []
            for _ in range(repeats + 1):
                begin = time.perf_counter()
                image = render(gaussians, views)
                middle = time.perf_counter()
                image.square().mean().backward()
                times.append((middle - begin, time.perf_counter() - middle))
            found.append(_row("cpu", gaussians, times[1:], 1e3) | {"threads": torch.get_num_threads()})
    finally:
        torch.set_num_threads(before)
    return found


def cuda_row(repeats: int) -> dict[str, Any]:
    """On CUDA: medians by the device's clock, warm. Forward is render; backward also has the loss, a sum."""
    views, gaussians = cameras().to(device="cuda", dtype=torch.float32), scenes()
    marks = []
    for _ in range(_WARM_UP + _CUDA_RUNS * repeats):
        for field in gaussians.fields().values():
            field.grad = None
        marks.append([torch.cuda.Event(enable_timing=True) for _ in range(3)])
        marks[-1][0].record()
        outputs = render(gaussians, views, alpha=True)
        marks[-1][1].record()
        _sum(*outputs).backward()
        marks[-1][2].record()
    torch.cuda.synchronize()
    times = [(a.elapsed_time(b), b.elapsed_time(c)) for a, b, c in marks[_WARM_UP:]]
    return _row("cuda", gaussians, times, 1.0) | {"card": torch.cuda.get_device_name()}


def _sum(image: Tensor, alpha: Tensor) -> Tensor:
    return image.sum() + alpha.sum()


def _row(device: str, gaussians: Gaussians, times: list[tuple[float, float]], to_ms: float) -> dict[str, Any]:
    forward, backward, total = (to_ms * statistics.median(part) for part in (*zip(*times), map(sum, times)))
    scenes = gaussians.means.shape[0]
    return {"device": device, "objects": scenes, "views": VIEWS, "images": scenes * VIEWS, "size_px": SIZE_PX,
            "gaussians": gaussians.count, "ms_forward": forward, "ms_backward": backward, "ms_total": total}


def table(found: list[dict[str, Any]]) -> str:
    """The rows as text, a line each."""
    return "\n".join(
        f"{row['objects']} objects x {row['views']} views, {row['size_px']} px, {row['gaussians']} Gaussians, "
        + (f"{row['threads']} threads" if row["device"] == "cpu" else row["card"])
        + f": forward {_ms(row['ms_forward'])}, backward {_ms(row['ms_backward'])}, both {_ms(row['ms_total'])} ms"
        for row in found)


def _ms(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.2f}"
