"""Drawing by WebGPU from anywhere in the package: devices by name, kept open for the frames to come."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Literal, NamedTuple, cast

from torch import Tensor

from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Device
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.webgpu.adapters import adapter_at
from lightfield_gs.webgpu.frames import Frames


def adapter_index(device: str) -> int:
    """Return N of webgpu:N, 0 of webgpu; raise InputError for other words."""
    found = re.fullmatch(r"webgpu(?::(\d{1,3}))?", device)
    if found is None:
        raise InputError(f"device: expected webgpu or webgpu:N, got {device!r}")
    return int(found[1] or 0)


class DrawingDevice(NamedTuple):
    """Where a command works.

    Attributes:
        torch: Device of the tensors: the scene, the network and what it makes.
        webgpu: Adapter that draws light fields, as `encode` takes it; None: the tensors' device draws them.
    """

    torch: Literal["cpu", "cuda"]
    webgpu: str | None = None


def choose_drawing_device(name: str) -> DrawingDevice:
    """Return the device of auto, cpu, cuda, webgpu or webgpu:N.

    Raises:
        InputError: It is not there, and what to do.
    """
    if not name.startswith("webgpu"):
        return DrawingDevice(choose_device(cast(Device, name)))
    adapter_at(adapter_index(name))
    return DrawingDevice("cpu", name)


@lru_cache
def frames_on(index: int) -> Frames:
    """Return the frames of an adapter, by its place in the list. Raises InputError."""
    adapter = adapter_at(index)
    return Frames(adapter.open(), adapter.limits)


def draw_direct(
    device: str,
    job: DirectRender,
    as_bytes: bool = False,
    quality: Quality = EXACT,
    stats: Stats | None = None,
    out: Tensor | None = None,
) -> Tensor:
    """Draw a light-field image [H, W, 3] by WebGPU; it lies on the CPU.

    Args:
        device: webgpu or webgpu:N.
        job: The render, its tensors on the CPU in float32.
        as_bytes: Whether the image is uint8 = round(255 clamp(c, 0, 1)), else float32.
        quality: Error allowed in colours; the rest is exact.
        stats: Filled with times and counts.
        out: An image of that size and type.

    Raises:
        InputError: There is no such adapter, or the scene is too large for it.
    """
    return frames_on(adapter_index(device)).draw(job, as_bytes, quality, stats or Stats(), out)
