"""What the rasterizer costs in a training step: 8 objects before 4 cameras each, 128 px, forward and backward.

Every object is two layers of 128 x 128 Gaussians, one behind the other, as the network draws them.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np
import torch

from lightfield_gs.bench_scenes import ZERO_DEPTH, sheet
from lightfield_gs.gaussians import Gaussians
from lightfield_gs.panel import Panel
from lightfield_gs.rendering import render
from lightfield_gs.rig import Rig

OBJECTS, VIEWS, SIZE_PX = 8, 4, 128
CONE_DEG = 40.0
LAYER_DISTANCE = 0.3  # scene units


def objects() -> Gaussians:
    """The batch of objects, leaf tensors that ask for gradients."""
    layered = []
    for index in range(OBJECTS):
        front, back = sheet(SIZE_PX, 2 * index), sheet(SIZE_PX, 2 * index + 1)
        back.means *= 1 + LAYER_DISTANCE / back.means[:, 2:]
        layered.append([torch.cat(pair) for pair in zip(front.fields().values(), back.fields().values())])
    return Gaussians(*(torch.stack(field).requires_grad_() for field in zip(*layered)))


def rows(threads: list[int | None], repeats: int) -> list[dict[str, Any]]:
    """A row for each number of threads (None: those torch uses); times are medians, after a first run to warm up."""
    # The sheet is twice as wide as high: half the focal length across makes it square.
    panel = Panel(SIZE_PX, SIZE_PX, VIEWS, line_number=3.0 * VIEWS, slant_tan=0.0, cone_deg=CONE_DEG)
    cameras = Rig(np.eye(4), (SIZE_PX, 2 * SIZE_PX), (SIZE_PX / 2, SIZE_PX / 2), ZERO_DEPTH).cameras(panel)
    gaussians = objects()
    before, found = torch.get_num_threads(), []
    try:
        for count in threads:
            torch.set_num_threads(before if count is None else count)
            times = []
            for _ in range(repeats + 1):
                begin = time.perf_counter()
                image = render(gaussians, cameras)
                middle = time.perf_counter()
                image.square().mean().backward()
                times.append((middle - begin, time.perf_counter() - middle))
            forward, backward = (1e3 * statistics.median(part) for part in zip(*times[1:]))
            found.append({"threads": torch.get_num_threads(), "objects": OBJECTS, "views": VIEWS, "size_px": SIZE_PX,
                          "gaussians": gaussians.count, "ms_forward": forward, "ms_backward": backward,
                          "ms_total": forward + backward})
    finally:
        torch.set_num_threads(before)
    return found


def table(found: list[dict[str, Any]]) -> str:
    """The rows as text, a line each."""
    return "\n".join(
        f"{row['objects']} objects x {row['views']} views, {row['size_px']} px, {row['gaussians']} Gaussians, "
        f"{row['threads']} threads: forward {row['ms_forward']:.0f} ms, backward {row['ms_backward']:.0f} ms"
        for row in found)
