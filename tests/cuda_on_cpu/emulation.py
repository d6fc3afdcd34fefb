"""Import this before anything that loads the native module.

The module of build.py, the program's first argument, replaces it. Streams and events of torch become stand-ins for a
CPU.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import types
from collections.abc import Callable

import torch

import lightfield_gs

torch.use_deterministic_algorithms(True)  # torch.empty gives NaN and largest numbers: what nothing has written shows
sys.setdlopenflags(os.RTLD_LAZY)  # the module has no CPU stages
_specification = importlib.util.spec_from_file_location("lightfield_gs._core", sys.argv[1])
sys.modules["lightfield_gs._core"] = lightfield_gs._core = importlib.util.module_from_spec(_specification)
_specification.loader.exec_module(lightfield_gs._core)
torch.cuda.current_stream = lambda *device: types.SimpleNamespace(cuda_stream=0)
torch.cuda.Event = lambda: types.SimpleNamespace(record=lambda: None, synchronize=lambda: None)


def use_cuda_stages() -> None:
    """Tensors on the CPU go through the CUDA stages, on one thread."""
    from lightfield_gs.encoding import sorted, sorted_plan
    from lightfield_gs.rasterizer import image_operators, workspace_cuda

    tile = sorted_plan._tile
    workspace_cuda.WORKSPACES["cpu"] = workspace_cuda.CudaWorkspace
    image_operators._is_for_cuda = lambda means: True
    sorted_plan._tile = lambda views, width_px, _: tile(views, width_px, "cuda")
    sorted._CpuStages = lambda scene, plan, threads: sorted.CudaStages(scene, plan)
    torch.set_num_threads(1)
    _use_cuda_fit()
    for stage in ("surface", "sheet", "find_object", "crop_object", "group_norm_silu"):
        setattr(lightfield_gs._core, stage, _on_cuda(stage))


def _on_cuda(stage: str) -> Callable[..., None]:
    """Return a stage of the CPU, whose last argument is the number of threads, that runs the CUDA stage."""
    return lambda *arguments: getattr(lightfield_gs._core.cuda, stage)(*arguments[:-1], 0)


def _use_cuda_fit() -> None:
    """The same for the stages of fitting, whose functions of the CPU this module lacks."""
    core, cuda = lightfield_gs._core, lightfield_gs._core.cuda
    core.photo_loss_partials = cuda.photo_loss_partials
    core.float32.photo_loss = lambda job, threads: cuda.photo_loss(job, 0)
    core.float32.update = lambda job, threads: cuda.update(job, 0)
    core.float32.normals = lambda *arguments: cuda.normals(*arguments[:-1], 0)
    core.float32.dropout = lambda job, threads: cuda.dropout(job, 0)
    core.uniforms = lambda *arguments: cuda.uniforms(*arguments[:-1], 0)
