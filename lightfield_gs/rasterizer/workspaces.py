"""The workspace of a scene's device."""

from __future__ import annotations

from lightfield_gs.rasterizer.scene import Scene, State
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import Workspace
from lightfield_gs.rasterizer.workspace_cpu import CpuWorkspace
from lightfield_gs.rasterizer.workspace_cuda import CudaWorkspace


def workspace_of(
    scene: Scene,
    images: int,
    width: int,
    height: int,
    stats: Stats,
    threads: int,
    *,
    lens: bool = False,
    colour_order: int = 0,
    compensated: bool = False,
    state: State | None = None,
    room: int | None = None,
) -> Workspace:
    """For `images` images of one size. lens, colour_order, compensated, state: see workspace.Splats; room: see
    dense_job.DenseJob."""
    if scene.device.type == "cuda":
        return CudaWorkspace(
            scene, images, width, height, colour_order, stats, lens, state, compensated=compensated, room=room
        )
    return CpuWorkspace(scene, images, width, height, colour_order, stats, threads, state, compensated)
