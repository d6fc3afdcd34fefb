"""Drawing by WebGPU from anywhere in the package: devices by name, kept open for the frames to come."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Literal, NamedTuple, cast

from torch import Tensor

from lightfield_gs.base.assumptions import Fallback, assume
from lightfield_gs.base.device import choose_device
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import Device
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.webgpu.adapters import adapter_at, adapters
from lightfield_gs.webgpu.frames import Frames
from lightfield_gs.webgpu.resident import Kept
from lightfield_gs.webgpu.self_test import known_self_test

_LOST = ("lost", "memory", "could not map")  # in wgpu's messages on a device that is gone, or full
_lost: set[int] = set()  # adapters whose device was lost: the CPU draws in their place
# Pixels of all frames of a command below which no GPU pays: the CPU draws them while drivers start, half a second
_LEAST_PIXELS = 1 << 24


class DrawingDevice(NamedTuple):
    """Where a command works.

    Attributes:
        torch: Device of the tensors: the scene, the network and what it makes.
        webgpu: Adapter that draws light fields, as `encode` takes it; None: the tensors' device draws them.
        messages: Lines on decisions.
    """

    torch: Literal["cpu", "cuda"]
    webgpu: str | None = None
    messages: tuple[str, ...] = ()


def adapter_index(device: str) -> int:
    """Return N of webgpu:N, 0 of webgpu; raise InputError for other words."""
    found = re.fullmatch(r"webgpu(?::(\d{1,3}))?", device)
    if found is None:
        raise InputError(f"device: expected webgpu or webgpu:N, got {device!r}")
    return int(found[1] or 0)


def choose_drawing_device(name: str, pixels: int, frames: int = 1) -> DrawingDevice:
    """Return the device of auto, cpu, cuda, webgpu or webgpu:N.

    auto takes CUDA. Without it, auto takes a GPU by WebGPU that passes the self-test, if it takes no longer than the
    CPU. For few pixels it starts no driver.

    Args:
        name: Of the device.
        pixels: Of the panel.
        frames: How many light fields the method direct draws, about. With 0 auto leaves WebGPU out.

    Raises:
        InputError: It is not there, and what to do.
    """
    if name.startswith("webgpu"):
        adapter_at(adapter_index(name))
        return DrawingDevice("cpu", name)
    device = choose_device(cast(Device, name))
    if name != "auto" or device == "cuda" or frames * pixels < _LEAST_PIXELS:
        return DrawingDevice(device)
    for index, adapter in enumerate(adapters()):
        if not adapter.is_cpu and (result := known_self_test(adapter)).pays(pixels, frames):
            message = f"drawn by WebGPU on {adapter}: {result.words()} (another: --device cpu)"
            return DrawingDevice("cpu", f"webgpu:{index}", (message,))
    return DrawingDevice("cpu")


def check_on_cpu(device: str, gaussians: Gaussians) -> None:
    """Raise InputError for Gaussians that WebGPU cannot read."""
    if gaussians.device.type != "cpu":
        raise InputError(
            f"device={device!r} takes Gaussians on the CPU, got {gaussians.device}: use gaussians.to('cpu')"
        )


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
    kept: Kept | None = None,
) -> Tensor:
    """Draw a light-field image [H, W, 3] by WebGPU; it lies on the CPU.

    Where the device is lost, or has too little memory, the CPU draws from then on, and one warning says so.

    Args:
        device: webgpu or webgpu:N.
        job: The render, its tensors on the CPU in float32.
        as_bytes: Whether the image is uint8 = round(255 clamp(c, 0, 1)), else float32.
        quality: See Frames.draw.
        stats: Filled with times and counts.
        out: An image of that size and type.
        kept: See Frames.draw.

    Raises:
        InputError: There is no such adapter, or the scene is too large for it.
    """
    index = adapter_index(device)
    if index not in _lost:
        frames = frames_on(index)
        from wgpu import GPUError

        try:
            return frames.draw(job, as_bytes, quality, stats or Stats(), out, kept)
        except (GPUError, RuntimeError) as error:
            words = str(error).splitlines()[-1].strip()
            if not any(word in str(error).lower() for word in _LOST):
                raise
        _lost.add(index)
        assume(f"device {device!r} failed ({words}): the CPU draws in its place", Fallback)
    return job.draw(as_bytes, quality, stats, out=out)
