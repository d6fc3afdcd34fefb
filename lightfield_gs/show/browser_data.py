"""What pages need to draw light fields themselves, as lightfield_gs/webgpu/browser and panels/browser take it."""

from __future__ import annotations

from typing import Any

from lightfield_gs.panels.rig import SIZE_KEY, Rig
from lightfield_gs.rasterizer.quality import EXACT
from lightfield_gs.webgpu.shaders import BINDINGS, STAGES, wgsl


def rig_numbers(rig: Rig, size_px: tuple[int, int]) -> dict[str, Any]:
    """Return a rig as lightfield_gs/panels/browser/rig.js takes it."""
    return {**rig.to_dict(), "world_to_camera": rig.world_to_camera.reshape(-1).tolist(), SIZE_KEY: size_px}


def host_tables() -> dict[str, Any]:
    """Return what lightfield_gs/webgpu/browser takes: the stages, and the error of colours of an exact picture."""
    stages = {
        name: {"files": stage.files, "bindings": stage.bindings} for name, stage in STAGES.items() if name != "pack"
    }
    used = dict.fromkeys(name for stage in stages.values() for name in stage["files"])
    return {
        "stages": stages,
        "bindings": BINDINGS,
        "files": {name: wgsl(name) for name in used},
        "colour_error": EXACT.colour_error,
    }
