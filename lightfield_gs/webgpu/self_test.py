"""Whether an adapter draws what the CPU draws, and as fast: a frame of both. Results are kept in the user's cache."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

import lightfield_gs
from lightfield_gs.base.system import cache_folder, cores
from lightfield_gs.io.atomic import atomic_path
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, lenticular_camera
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.quality import EXACT
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.webgpu.adapters import Adapter
from lightfield_gs.webgpu.frames import Frames

_SIZE_PX = 1920, 1080
_COUNT = 20_000
_MOST_APART = 1  # of 255
_REPEATS = 3


class SelfTest(NamedTuple):
    """What a self-test found.

    Attributes:
        apart: The largest difference from the CPU's image, of 255.
        open_ms: Milliseconds until the device and its pipelines stand, the first frame among them.
        frame_ms: Milliseconds of a frame on the adapter, with the copy of the image to the host.
        cpu_ms: Milliseconds of the same frame on the CPU.
    """

    apart: int
    open_ms: float
    frame_ms: float
    cpu_ms: float

    @property
    def is_right(self) -> bool:
        """Whether the image is that of the CPU."""
        return self.apart <= _MOST_APART

    def pays(self, pixels: int, frames: int) -> bool:
        """Return whether so many frames of a panel take no longer than on the CPU; both grow with the pixels."""
        scale = frames * pixels / (_SIZE_PX[0] * _SIZE_PX[1])
        return self.is_right and self.open_ms + scale * self.frame_ms <= scale * self.cpu_ms

    def words(self) -> str:
        """Return the result for people."""
        right = "exact to 1/255" if self.is_right else f"wrong, off by up to {self.apart}/255"
        return f"{right}, {self.frame_ms:.0f} ms a frame, the CPU {self.cpu_ms:.0f} ms, {self.open_ms:.0f} ms to start"


def self_test(adapter: Adapter) -> SelfTest:
    """Draw a frame of 1920 x 1080 pixels on the adapter and on the CPU, and compare images and times."""
    job = standard_frame()
    expected, cpu_ms = _timed(lambda: job.draw(True))
    begin = time.perf_counter()
    frames = Frames(adapter.open(), adapter.limits)
    draw = lambda: frames.draw(job, True, EXACT, Stats(), None)
    draw()
    open_ms = 1e3 * (time.perf_counter() - begin)
    image, frame_ms = _timed(draw)
    frames.buffers.release()
    return SelfTest(int((image.int() - expected.int()).abs().max()), open_ms, frame_ms, cpu_ms)


def known_self_test(adapter: Adapter) -> SelfTest:
    """Return the result of the self-test, of an earlier run if this machine, driver and version are the same."""
    path, key = cache_folder() / "webgpu.json", _key(adapter)
    results = _read(path)
    if key not in results:
        results[key] = list(self_test(adapter))
        _write(path, results)
    apart, open_ms, frame_ms, cpu_ms = results[key]
    return SelfTest(int(apart), float(open_ms), float(frame_ms), float(cpu_ms))


def standard_frame() -> DirectRender:
    """Return the render of a cloud of Gaussians on a panel of 1920 x 1080 pixels with stripes."""
    random = np.random.default_rng(0)
    means = random.uniform(-0.6, 0.6, (_COUNT, 3)) * (1.6, 0.9, 0.5) + (0, 0, 2)
    scales = np.exp(random.normal(np.log(0.01), 0.5, (_COUNT, 3)))
    fields = (
        *(means, random.normal(size=(_COUNT, 4)), scales),
        *(random.uniform(0.1, 0.95, _COUNT), random.uniform(-1.5, 1.5, (_COUNT, 1, 3))),
    )
    width, height = _SIZE_PX
    panel = Panel(
        width_px=width, height_px=height, views=64, line_number=16.013, slant_tan=0.182, phase=0.0, cone_deg=30.0
    )
    rig = Rig(np.eye(4), (width, width), (width / 2, height / 2), 2.0)
    tensors = [torch.from_numpy(np.ascontiguousarray(field, np.float32)) for field in fields]
    return DirectRender(tensors, torch.ones(3), lenticular_camera(panel, rig))


def _timed(draw: Callable[[], Tensor]) -> tuple[Tensor, float]:
    """Return an image and the milliseconds that it takes, the least of a few."""
    times = []
    for _ in range(_REPEATS):
        begin = time.perf_counter()
        image = draw()
        times.append(1e3 * (time.perf_counter() - begin))
    return image, min(times)


def _key(adapter: Adapter) -> str:
    """Return what a result depends on."""
    parts = (adapter.name, adapter.backend, adapter.driver, f"{len(cores())} cores", lightfield_gs.__version__)
    return " | ".join(parts)


def _read(path: Path) -> dict[str, Any]:
    """Return the stored results; {} where there are none that can be read."""
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    good = isinstance(results, dict) and all(isinstance(row, list) and len(row) == 4 for row in results.values())
    return results if good else {}


def _write(path: Path, results: dict[str, Any]) -> None:
    """Store the results, where the user's cache can be written to: without it the next run tests again."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    except OSError:
        return
