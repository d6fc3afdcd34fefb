"""Measure the renderer of meshes: `python -m training.meshes.benchmark data/meshes`.

Scenes are those of training with the default options, all pictures of one size. The program prints views per second,
and the milliseconds of each stage per view: planning on the host, projecting, finding the nearest triangles, shading.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lightfield_gs.base.checks import whole_number
from lightfield_gs.base.device import choose_device
from training.command import with_line_errors
from training.data.transfer import on_device
from training.meshes.pack import ResidentMeshes, read_meshes
from training.meshes.rasterize import project, rasterize
from training.meshes.render import SAMPLES, Scene, render_images
from training.meshes.scenes import Framing, MeshOptions, MeshScenes

CONE_DEG = (25.0, 12.0)


def _scenes(source: MeshScenes, examples: int, views: int, size_px: int) -> Iterator[Scene]:
    """Yield the targets of one step after the other, on the host."""
    step = 0
    framing = Framing(
        np.ones((examples, 1 + views)),
        np.zeros((examples, 1 + views, 2)),
        np.ones((examples, views, 3)),
        np.zeros(examples, bool),
        0.5,
    )
    while True:
        rng = np.random.default_rng(step)
        yield source.plan(rng, np.arange(examples), examples, (size_px, size_px), framing).targets
        step += 1


class _Clock:
    """Mean milliseconds of stages; waits for the device before and after each."""

    def __init__(self, device: torch.device) -> None:
        self._device, self.ms = device, dict[str, list[float]]()

    def _wait(self) -> float:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()

    def timed(self, stage: str, function: Callable[..., Any], *arguments: Any) -> Any:
        begun = self._wait()
        found = function(*arguments)
        self.ms.setdefault(stage, []).append(1e3 * (self._wait() - begun))
        return found


def _nearest(meshes: ResidentMeshes, scene: Scene, clock: _Clock, compiled: bool) -> None:
    """Time the stages before shading by themselves."""
    draws, side = scene.draws, SAMPLES * scene.size_px
    projected = clock.timed("project", project, meshes, draws, scene.to_camera, SAMPLES * scene.intrinsics)
    view = draws.view[projected.draw]
    clock.timed(
        "rasterize", rasterize, projected.points[projected.corners], view, draws.views, (side, side), None, compiled
    )


@torch.no_grad()
def measure(
    source: MeshScenes, examples: int, views: int, size_px: int, steps: int, compiled: bool
) -> dict[str, float]:
    """Return mean milliseconds of each stage, of all views of a step, after three steps that do not count.

    Args:
        examples: Scenes of a step.
        views: Pictures of a scene.
        compiled: See render_images.
    """
    meshes, scenes = source.meshes, _scenes(source, examples, views, size_px)
    for step in range(-3, steps):
        if step <= 0:
            clock = _Clock(meshes.device)
        scene = clock.timed("plan", next, scenes)
        scene = clock.timed("copy", on_device, scene, meshes.device)
        _nearest(meshes, scene, clock, compiled)
        clock.timed("render", render_images, meshes, scene, None, compiled)
    return {stage: float(np.mean(times)) for stage, times in clock.ms.items()}


@with_line_errors("training.meshes.benchmark")
def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m training.meshes.benchmark",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("meshes", type=Path, help="folder of mesh packs")
    parser.add_argument("--split", default="train", help="objects to draw (default: train)")
    parser.add_argument("--size", type=int, default=128, help="side of the pictures, pixels (default: 128)")
    parser.add_argument("--examples", type=int, default=32, help="scenes of a step (default: 32)")
    parser.add_argument("--views", type=int, default=4, help="pictures of a scene (default: 4)")
    parser.add_argument("--steps", type=int, default=20, help="steps to measure (default: 20)")
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    parser.add_argument("--compile", action="store_true", help="let torch.compile make some kernels")
    options = parser.parse_args(arguments)
    size, examples, views, steps = (
        whole_number(f"--{name}", getattr(options, name), 1, 4096) for name in ("size", "examples", "views", "steps")
    )
    device = torch.device(choose_device(options.device))
    begun = time.perf_counter()
    meshes = ResidentMeshes(read_meshes(options.meshes, options.split), device)
    print(f"{len(meshes.meshes)} objects read in {time.perf_counter() - begun:.1f} s")
    found = measure(
        MeshScenes(meshes, MeshOptions(str(options.meshes)), CONE_DEG), examples, views, size, steps, options.compile
    )
    for stage, ms in found.items():
        print(f"{stage:<10}{ms:10.2f} ms for {examples * views} views")
    print(f"{1e3 * examples * views / found['render']:.0f} views of {size} px a second on {device}")
    if device.type == "cuda":
        print(f"{torch.cuda.max_memory_allocated() / 2**30:.2f} GiB at most")
    return 0


if __name__ == "__main__":
    sys.exit(main())
