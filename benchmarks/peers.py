"""Other programs beside ours in the benchmarks, when they are installed.

gsplat draws the views of the classic pipeline, and is compared with a training step. Source: Ye et al., "gsplat: An
Open-Source Library for Gaussian Splatting", JMLR 2025; PyPI `gsplat`, Apache-2.0.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import to_bytes
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

GSPLAT_OPTIONS = {"packed": False, "rasterize_mode": "classic", "eps2d": 0.3, "near_plane": 0.01, "radius_clip": 0.0}
BYTES_PER_PIXEL = 20  # of gsplat's image, coverage and last index
BYTES_AT_A_TIME = 4 << 30  # the most that dense views take which are held together


@lru_cache(maxsize=1)
def gsplat() -> Any:
    """The module gsplat with its CUDA part. Raises InputError when there is none, or no GPU."""
    if not torch.cuda.is_available():
        raise InputError("gsplat needs a GPU (device='cuda'), and torch finds none here")
    try:
        import gsplat as module
        from gsplat.cuda._backend import _C as native
    except (ImportError, RuntimeError, OSError) as error:
        raise InputError(f"gsplat could not be imported ({error}): pip install gsplat, with nvcc at hand") from None
    if native is None:
        raise InputError("gsplat is installed without its CUDA part: it needs nvcc when it is first imported")
    return module


class GsplatClassic:
    """The classic pipeline with gsplat: N dense views, several in a call, and their sub-pixels taken over on the GPU.

    Called, it returns the 8-bit image [H, W, 3] that the panel shows before a white background. The cameras and the
    places of each view's sub-pixels belong to the panel: they are made once, before any time is taken.
    """

    def __init__(self, gaussians: Gaussians, panel: Panel, rig: Rig) -> None:
        self._rasterization = gsplat().rasterization
        self._gaussians, self._panel = gaussians, panel
        self._views_a_call = max(
            1, min(panel.views, BYTES_AT_A_TIME // (BYTES_PER_PIXEL * panel.width_px * panel.height_px))
        )
        self._cameras = rig.cameras(panel).to(gaussians.means)
        self._sources, self._places = _interlace_plan(panel, self._views_a_call, gaussians.device)

    @torch.no_grad()
    def __call__(self) -> Tensor:
        height, width = self._panel.height_px, self._panel.width_px
        out = torch.empty(height * width * 3, dtype=torch.uint8, device=self._gaussians.device)
        for first, sources, places in zip(range(0, self._panel.views, self._views_a_call), self._sources, self._places):
            views = self._dense(slice(first, first + self._views_a_call))
            out[places] = to_bytes(views.view(-1)[sources])
        return out.view(height, width, 3)

    def _dense(self, views: slice) -> Tensor:
        """Dense views [C, H, W, 3], float32."""
        return _rasterize(self._rasterization, self._gaussians, self._cameras.select(views))[0]

    def counted(self) -> dict[str, Any]:
        """Return the counters of a run by the names of `encode`; None for counters that gsplat lacks."""
        events = [torch.cuda.Event(enable_timing=True) for _ in range(3)]
        events[0].record()
        with torch.no_grad():
            for first in range(0, self._panel.views, self._views_a_call):
                self._dense(slice(first, first + self._views_a_call))
        events[1].record()
        self()
        events[2].record()
        events[2].synchronize()
        views, whole = events[0].elapsed_time(events[1]), events[1].elapsed_time(events[2])
        return {
            "stages_ms": {"dense views": views, "interlace": max(0.0, whole - views)},
            "pairs": None,
            "evaluations_per_subpixel": None,
            "work_bytes": None,
        }


def gsplat_images(gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Images [B, C, H, W, 3] before white, and their coverage, of B scenes [B, N, ...] on the GPU before C cameras.

    Differentiable in every field of the Gaussians. Raises InputError.
    """
    return _rasterize(gsplat().rasterization, gaussians, cameras)


def intrinsic_matrices(cameras: Cameras) -> Tensor:
    """[C, 3, 3], fx 0 cx over 0 fy cy over 0 0 1, as gsplat takes them."""
    matrices = torch.zeros(cameras.count, 3, 3, dtype=cameras.focal_px.dtype, device=cameras.focal_px.device)
    matrices[:, 0, 0], matrices[:, 1, 1], matrices[:, 0, 2], matrices[:, 1, 2] = cameras.intrinsics().unbind(-1)
    matrices[:, 2, 2] = 1
    return matrices


def _rasterize(rasterization: Any, gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """gsplat's images [..., C, H, W, 3] before white and their coverage [..., C, H, W, 1], its numerics as ours."""
    lead, count = gaussians.means.shape[:-2], cameras.count
    degree = gaussians.sh_degree
    colours = gaussians.sh if degree else (0.5 + SH_CONSTANT * gaussians.sh[..., 0, :]).clamp_min(0)
    image, coverage, _ = rasterization(
        gaussians.means,
        gaussians.quaternions,
        gaussians.scales,
        gaussians.opacities,
        colours,
        cameras.world_to_camera.expand(*lead, count, 4, 4),
        intrinsic_matrices(cameras).to(gaussians.means).expand(*lead, count, 3, 3),
        cameras.width_px,
        cameras.height_px,
        sh_degree=degree or None,
        **GSPLAT_OPTIONS,
        backgrounds=torch.ones(*lead, count, 3, dtype=gaussians.dtype, device=gaussians.device),
    )
    return image, coverage


@lru_cache(maxsize=1)
def _interlace_plan(panel: Panel, views_a_call: int, device: torch.device) -> tuple[list[Tensor], list[Tensor]]:
    """For every call: where its sub-pixels lie in the dense views (flat), and in the image (flat); int64, by view."""
    view_map = panel.view_map().reshape(-1)
    numbers = torch.from_numpy(view_map).to(device)
    places = torch.argsort(numbers, stable=True)
    sources = numbers[places].to(torch.int64).remainder_(views_a_call).mul_(len(view_map)).add_(places)
    per_view = np.bincount(view_map, minlength=panel.views)
    per_call = [int(per_view[first : first + views_a_call].sum()) for first in range(0, panel.views, views_a_call)]
    return list(sources.split(per_call)), list(places.split(per_call))
