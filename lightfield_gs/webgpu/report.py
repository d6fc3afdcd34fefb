"""What to send of an adapter that was not tried: its limits, and bytes and times of a frame, tiling by tiling."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from importlib.metadata import version

import lightfield_gs
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.quality import EXACT
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.webgpu.adapters import Adapter, adapter_at, adapters
from lightfield_gs.webgpu.frames import Frames
from lightfield_gs.webgpu.parameters import tilings
from lightfield_gs.webgpu.pipelines import Clock
from lightfield_gs.webgpu.resident import Kept
from lightfield_gs.webgpu.self_test import standard_frame

_LIMITS = (
    "max-buffer-size",
    "max-storage-buffer-binding-size",
    "max-storage-buffers-per-shader-stage",
    "max-compute-workgroup-storage-size",
    "max-compute-invocations-per-workgroup",
    "max-compute-workgroups-per-dimension",
)
_FRAMES = 5  # that count; one before them compiles


def report() -> str:
    """Return the text on all adapters, for an issue."""
    lines = [
        f"lightfield-gs {lightfield_gs.__version__}, wgpu {version('wgpu')}, Python {platform.python_version()}, "
        f"{platform.platform()}, {platform.machine()}"
    ]
    for index, adapter in enumerate(adapters()):
        lines += ["", f"webgpu:{index}: {adapter}, driver {adapter.driver or 'unnamed'}"]
        lines.append("  limits: " + ", ".join(f"{name} {adapter.gpu.limits[name]}" for name in _LIMITS))
        lines.append(f"  features: {', '.join(sorted(adapter.gpu.features))}")
        lines += [f"  {line}" for line in _times(index, adapter)]
    return "\n".join(lines)


def _times(index: int, adapter: Adapter) -> Iterator[str]:
    """Give a line on each tiling of the frame of the self-test; one on what failed, and none after it."""
    from wgpu import GPUError

    try:
        adapter_at(index)
        yield from _measured(adapter)
    except (InputError, GPUError, RuntimeError) as error:
        yield f"failed: {' '.join(str(error).split())}"


def _measured(adapter: Adapter) -> Iterator[str]:
    job, kept = standard_frame(), Kept.new()
    expected = job.draw(True)
    frames = Frames(adapter.open(), adapter.limits)
    has_clock = "timestamp-query" in frames.device.features
    frames.clock = Clock(frames.device) if has_clock else None
    lens = job.camera.lens
    yield f"{lens.width_px} x {lens.height_px} pixels, {job.scene.count} Gaussians, the least of {_FRAMES} frames, ms:"
    for frames.tiling in tilings(lens):
        walls, stages = [], list[dict[str, float]]()
        for _ in range(1 + _FRAMES):
            stats, began = Stats(), time.perf_counter()
            image = frames.draw(job, True, EXACT, stats, None, kept)
            walls.append(1e3 * (time.perf_counter() - began))
            stages.append({} if frames.clock is None else frames.clock.stages_ms())
        apart = int((image.int() - expected.int()).abs().max())
        parts = (f"{name} {min(one.get(name, 0.0) for one in stages[1:]):.3g}" for name in stages[-1])
        yield f"{stats.kernel}: off by {apart}/255, {min(walls[1:]):.3g} with the copy; {', '.join(parts)}"
    frames.buffers.release()
