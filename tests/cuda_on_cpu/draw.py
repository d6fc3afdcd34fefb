"""python draw.py MODULE KERNEL|dense OUT: the cases as drawn by the CUDA stages in a native module made by build.py.

OUT: by torch.save, a list of images and what was counted, one for every frame of cases.py, or the numbers of dense.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import types

import torch

sys.setdlopenflags(os.RTLD_LAZY)  # the module has no CPU stages
import lightfield_gs  # noqa: E402

specification = importlib.util.spec_from_file_location("lightfield_gs._core", sys.argv[1])
sys.modules["lightfield_gs._core"] = lightfield_gs._core = importlib.util.module_from_spec(specification)
specification.loader.exec_module(lightfield_gs._core)
torch.cuda.current_stream = lambda *device: types.SimpleNamespace(cuda_stream=0)

import cases  # noqa: E402

from lightfield_gs import frame_cuda, ops  # noqa: E402
from lightfield_gs.quality import EXACT  # noqa: E402
from lightfield_gs.rendering import lens_arguments  # noqa: E402
from lightfield_gs.workspace_cuda import CudaWorkspace  # noqa: E402


def workspace(scene, images, width, height, colour_order, stats, threads, **options):
    return CudaWorkspace(scene, images, width, height, colour_order, stats, **options)


def frame(kernel: str, name: str, degree: int, views: str) -> dict[str, object]:
    """Continuous views: with half the places that the pairs need."""
    panel, scene, continuous = cases.panel_of(name), cases.scene_of(degree), views == "continuous"
    job = ops.LensArguments(*scene.fields().values(), torch.tensor(cases.BACKGROUND),
                            *lens_arguments(panel, cases.rig_of(panel), continuous))

    def with_places(places: int) -> frame_cuda.Frame:
        return frame_cuda.Frame(job.scene, job.rig, job.lens, 8 if degree else 0, EXACT, places, kernel)

    probe = with_places(0)
    probe.project(), probe.order(), probe.count(), probe.fill()
    pairs, image = probe.state()["pairs"], torch.full((job.height, job.width, 3), 7.0)
    drawn = with_places(pairs // 2 if continuous else pairs + 5)
    drawn.draw(job.background, image)
    return {"image": image, **drawn.state()}


def main(what: str) -> object:
    torch.set_num_threads(1)
    ops._workspace = workspace
    if what == "dense":
        return cases.dense_step(torch.float32)
    return [frame(what, *case) for case in cases.frames_of(what)]


if __name__ == "__main__":
    torch.save(main(sys.argv[2]), sys.argv[3])
