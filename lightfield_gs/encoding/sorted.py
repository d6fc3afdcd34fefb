"""The method `sorted`: a light-field image from any cameras and any view map (Shi et al. 2025, sections 3.1 and 3.3).

Views are drawn in chunks, as large as a memory budget allows, which reuse the buffers. Each view is projected, ordered
and binned like an ordinary image, and only its own sub-pixels are drawn, straight into the panel's image.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import check_tensor, to_bytes
from lightfield_gs.base.device import device_guard
from lightfield_gs.base.errors import InputError
from lightfield_gs.encoding.sorted_plan import SortedPlan, panel_plan, views_shown
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.lenticular_camera import PINHOLE, Aperture
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import CpuWorkspace, RenderSize, SceneTensors, float_and_byte_addresses
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

_MOST_VIEWS, _MOST_NUMBERED = 4096, (1 << 31) - 1  # of a chunk: views; splats, and lists
# Bytes of a chunk: for a splat (footprint 32, colour 16, depth 4), an intersection, a list of intersections, and the
# gaps between parts
_SPLAT_BYTES, _INTERSECTION_BYTES, _LIST_BYTES, _GAPS = 52, 4, 12, 2048
_STATE = struct.Struct("<Q4xI")  # SortedState: intersections, the long lists, and splats drawn


class CudaStages:
    """The stages of a chunk on CUDA (csrc/cuda/sorted), and the bytes that they take; like _CpuStages."""

    default_work = 1 << 30
    reserve = 256  # 1 / reserve of the budget is left, for torch rounds every buffer up

    def __init__(self, scene: SceneTensors, plan: SortedPlan):
        self.scene, self.plan = scene, plan
        self.most_views = max(1, min(_MOST_VIEWS, _MOST_NUMBERED // max(scene.count, plan.tiles)))

    def geometry_bytes(self, views: int) -> int:
        return views * self.scene.count * _SPLAT_BYTES

    def binning_bytes(self, views: int, counts: tuple[int, int]) -> int:
        return _INTERSECTION_BYTES * counts[0] + _LIST_BYTES * views * self.plan.tiles + _GAPS

    def workspace(self, scene: SceneTensors, views: int, stats: Stats) -> Any:
        return SortedWorkspace(scene, self.plan, views, stats)

    def counts(self, work: Any) -> tuple[int, int]:
        return work.intersection_count, 0

    def composite(
        self, work: Any, cameras: _core.float32.Cameras, lists: tuple[Tensor, Tensor], background: Tensor, out: Tensor
    ) -> None:
        native = _core.SubpixelLists(self.plan.tile, *(t.data_ptr() for t in lists))
        _core.cuda.composite_sorted(
            work.native, native, background.data_ptr(), *float_and_byte_addresses(out), work.stream
        )


class SortedWorkspace:
    """The stages of workspace.CpuWorkspace for one chunk.

    Its memory is one buffer, and one more for the lists. The host waits for the number of intersections before.
    """

    def __init__(self, scene: SceneTensors, plan: SortedPlan, views: int, stats: Stats):
        self.scene, self.views, self.stats, self.intersection_count = scene, views, stats, 0
        self.native = _core.cuda.SortedChunk(
            views=views, gaussians=scene.count, width_px=plan.width_px, height_px=plan.height_px, tile=plan.tile
        )
        self.work = scene.new(self.native.bytes(), dtype=torch.uint8)
        self.native.place(self.work.data_ptr())
        self.stream = torch.cuda.current_stream(scene.device).cuda_stream

    def project_images(self, cameras: _core.float32.Cameras) -> None:
        _core.cuda.project_sorted(self.native, self.scene.native(), cameras, self.stream)

    def order_and_bin(self, admit: Callable[[], bool]) -> bool:
        """List the intersections and order them; see workspace.CpuWorkspace."""
        cuda, stats = _core.cuda, self.stats
        with stats.stage("bin"):
            cuda.count_sorted(self.native, self.stream)
            # The state lies first in the work memory: the numbers of intersections and of splats drawn
            state = self.work[: cuda.SORTED_STATE_BYTES].to("cpu", non_blocking=True)
            counted = torch.cuda.Event()
            counted.record()
            counted.synchronize()
            self.intersection_count, drawn = _STATE.unpack(bytes(state.numpy()))
            if not admit():
                return False
            self.ids = self.scene.new(self.intersection_count, dtype=torch.int32)
            self.native.place_ids(self.ids.data_ptr())
            cuda.fill_sorted(self.native, self.stream)
        with stats.stage("order"):
            cuda.order_sorted(self.native, self.stream)
        stats.intersections += self.intersection_count
        stats.images += self.views
        stats.gaussians_drawn += drawn
        return True


_MOST_INTERSECTIONS = (1 << 31) - 1
_PROBE = 65536  # Gaussians whose intersections are counted at a time, where even one view does not fit the budget
_GUESSED_INTERSECTIONS = 4  # of a Gaussian in a view, until the first chunk is counted

Counts = tuple[int, int]  # intersections of a chunk, and the most in one band of one view


def cameras_and_plan(
    panel: Panel,
    rig: Rig | None,
    cameras: Cameras | None,
    view_map: np.ndarray | Tensor | SortedPlan | None,
    continuous: bool,
    device: torch.device,
) -> tuple[Cameras, SortedPlan]:
    """Return the cameras and the plan of encode_sorted from the arguments of `encode`. Raises InputError."""
    if rig is None and cameras is None:
        raise InputError("method sorted takes a rig, or cameras= with one for each view; got neither")
    if continuous:
        if rig is None or cameras is not None or view_map is not None:
            raise InputError(
                "continuous views are those of a rig and the panel's own lens: leave out cameras= and "
                "view_map=, or use integer views"
            )
        places, x = views_shown(panel, True)
        table = places.astype(np.int32).reshape(panel.height_px, panel.width_px, 3)
        return rig.cameras_at(panel, x), SortedPlan(panel, table, len(x), device)
    if cameras is None:
        cameras = cast(Rig, rig).cameras(panel)
    elif cameras.world_to_camera.dim() != 3 or (cameras.width_px, cameras.height_px) != (
        panel.width_px,
        panel.height_px,
    ):
        raise InputError(
            f"cameras must be one for each view, [N, 4, 4], for images of {panel.width_px} x "
            f"{panel.height_px} px, the panel's; got {list(cameras.world_to_camera.shape)} for "
            f"{cameras.width_px} x {cameras.height_px}"
        )
    if view_map is None and cameras.count != panel.views:
        raise InputError(
            f"the panel has {panel.views} views, so cameras must be {panel.views}, got {cameras.count}; "
            "for another number give a view_map too"
        )
    if isinstance(view_map, SortedPlan):
        plan = view_map
    elif view_map is None:
        plan = panel_plan(panel, device.type)
    else:
        plan = SortedPlan(panel, view_map, cameras.count, device)
    if (plan.width_px, plan.height_px, plan.views) != (panel.width_px, panel.height_px, cameras.count):
        raise InputError(
            f"the plan is for {plan.width_px} x {plan.height_px} px and {plan.views} views, and panel and "
            f"cameras are {panel.width_px} x {panel.height_px} px and {cameras.count}"
        )
    return cameras, plan


class _CpuStages:
    """The stages of a chunk on the CPU, and the bytes that they take."""

    default_work = 1 << 28  # bytes beside the plan where no budget is given; with more, views take no less time
    reserve = 16  # 1 / reserve of the budget is left for partly used pages and for the C library
    most_views = 4096  # in a chunk

    def __init__(self, scene: SceneTensors, plan: SortedPlan, threads: int):
        self.scene, self.plan, self.threads = scene, plan, threads
        self.number = scene.tensors[0].element_size()
        self.bands = _core.band_count(plan.height_px)

    def geometry_bytes(self, views: int) -> int:
        """Return the bytes of splats and colours."""
        return views * self.scene.count * (self.number * (_core.SPLAT_FIELDS + _core.COLOUR_STRIDE) + 4)

    def binning_bytes(self, views: int, counts: Counts) -> int:
        """Return the bytes of order and lists of bands, plus the largest temporary memory of a stage."""
        (intersections, most), n, tiles = counts, self.scene.count, -(-self.plan.width_px // self.plan.tile.width_px)
        lists = views * (4 * n + 8 + 8 * self.bands) + 8 + 4 * intersections
        order = min(self.threads, views) * n * 4 * self.number
        bins = 8 * views * self.bands + self.threads * 8 * n
        # A growing vector may be twice as long as needed, beside its old memory
        tile_lists = 24 * self.bands + self.threads * (32768 + 3 * (most * (8 + 4 * tiles) + 16 * (tiles + 1)))
        return lists + max(order, bins, tile_lists)

    def workspace(self, scene: SceneTensors, views: int, stats: Stats) -> CpuWorkspace:
        size = RenderSize(views, self.plan.width_px, self.plan.height_px)
        return CpuWorkspace(scene, size, stats, self.threads)

    def counts(self, work: CpuWorkspace) -> Counts:
        per_band = work.band_offsets.diff()
        return work.intersection_count, int(per_band.max()) if per_band.numel() else 0

    def composite(
        self,
        work: CpuWorkspace,
        cameras: _core.float32.Cameras,
        lists: tuple[Tensor, Tensor],
        background: Tensor,
        out: Tensor,
    ) -> None:
        native = _core.SubpixelLists(self.plan.tile, *(t.data_ptr() for t in lists))
        work.stats.count(
            self.scene.core.composite_sorted(
                work.splats.native,
                work.bins,
                cameras,
                native,
                background.data_ptr(),
                *float_and_byte_addresses(out),
                self.threads,
            )
        )


@torch.no_grad()
def encode_sorted(
    gaussians: Gaussians,
    cameras: Cameras,
    plan: SortedPlan,
    budget: int | None,
    background: Tensor,
    as_bytes: bool,
    threads: int | None,
    stats: Stats,
    antialiased: bool = False,
    aperture: Aperture = PINHOLE,
) -> Tensor:
    """Draw the image [H, W, 3], view n of the plan as camera n sees it, without gradients.

    Args:
        gaussians: one scene, float32 or float64.
        cameras: one for each view of the plan.
        plan: of the panel's sub-pixels.
        budget: bytes of work memory on the device, beside image, Gaussians and view map. None: the plan and
            default_work, or the memory of one view if that is more.
        background: [3].
        as_bytes: whether the image is uint8.
        threads: of the CPU; None: torch's.
        stats: filled with counts; memory_bytes {geometry, image, binning} of the largest chunk, and
            memory_bytes_unchunked of all views at once: the states of Table 3 of the paper. image: the sorted
            sub-pixels.
        antialiased: see encode.
        aperture: of all cameras.

    Raises:
        InputError: if not even one view fits the budget.
    """
    scene = SceneTensors(*(field.unsqueeze(0) for field in gaussians.fields().values()))
    device = scene.device
    if plan.device_type != device.type:
        raise InputError(
            f"the plan was made for {plan.device_type}, and the Gaussians are on {device}: make "
            f"SortedPlan(..., device='{device.type}')"
        )
    background = check_tensor("background", background, (3,), scene.dtype, scene.device)
    out = scene.new(plan.height_px, plan.width_px, 3, dtype=torch.uint8 if as_bytes else None)
    if plan.hidden:
        out[:] = to_bytes(background.clone()) if as_bytes else background
    with device_guard(scene.device):
        threads = threads or torch.get_num_threads()
        _Encoding(scene, cameras, plan, budget, background, threads, stats, antialiased, aperture).run(out)
    return out


def _camera_tensors(cameras: Cameras, plan: SortedPlan, scene: SceneTensors) -> list[Tensor]:
    """Return poses, intrinsics and limits of the cameras of all views shown, for the native code.

    They go to the device at once and in one copy: a copy from the host waits until the device has nothing else to do.
    """
    if scene.dtype == torch.float64:
        cameras = cameras.to(scene.dtype)  # before the default limits are computed
    tensors = [cameras.world_to_camera, cameras.intrinsics(), cameras.limits()]
    if plan.count < cameras.count:
        tensors = [t[torch.from_numpy(plan.shown)] for t in tensors]
    together = torch.cat([t.flatten() for t in tensors]).to(scene.device, scene.dtype)
    return [part.view_as(t) for part, t in zip(together.split([t.numel() for t in tensors]), tensors)]


class _Encoding:
    """One image: its chunks of views, and their memory."""

    def __init__(
        self,
        scene: SceneTensors,
        cameras: Cameras,
        plan: SortedPlan,
        budget: int | None,
        background: Tensor,
        threads: int,
        stats: Stats,
        antialiased: bool,
        aperture: Aperture,
    ):
        self.scene, self.plan, self.budget = scene, plan, budget
        self.background, self.threads, self.stats = background, threads, stats
        self.antialiased, self.aperture = antialiased, aperture
        self.cameras = _camera_tensors(cameras, plan, scene)
        self.device = scene.device
        self.stages = CudaStages(scene, plan) if self.device.type == "cuda" else _CpuStages(scene, plan, threads)
        total = budget or self.stages.default_work + plan.table_bytes() + plan.bytes()
        self.usable = total - total // self.stages.reserve
        self.resident = True  # whether the whole plan is kept, and not only the lists of the chunk at hand
        self.expected: Counts = (_GUESSED_INTERSECTIONS * scene.count, scene.count // 8)  # of one view
        self.total: Counts = (0, 0)

    def run(self, out: Tensor) -> None:
        """Draw all views into `out`.

        A chunk that does not fit is made smaller, down to one view. If one view does not fit, the plan is no longer
        kept whole; at last the budget is refused.
        """
        first, plan = 0, self.plan
        while first < plan.count:
            views = self._most_views(first)
            while not self._draw(first, views, out):
                if views > 1:
                    views = min(views - 1, self._most_views(first))
                elif self.resident:
                    self._drop_plan()
                else:
                    self._refuse()
            first += views
        everything = self._memory(0, plan.count, self.total, resident=True)
        self.stats.memory_bytes_unchunked = everything
        self.stats.memory_bytes = self.stats.memory_bytes or dict.fromkeys(everything, 0)

    def _memory(self, first: int, views: int, counts: Counts, resident: bool | None = None) -> dict[str, int]:
        """Return the bytes of a chunk of views by stage."""
        plan, resident = self.plan, self.resident if resident is None else resident
        lists = plan.bytes() if resident else plan.bytes(first, first + views)
        return {
            "geometry": self.stages.geometry_bytes(views) + sum(t.nbytes for t in self.cameras),
            "image": plan.table_bytes() + lists,
            "binning": self.stages.binning_bytes(views, counts),
        }

    def _most_views(self, first: int) -> int:
        """Return how many views from `first` are expected to fit; at least one."""
        intersections, most = self.expected
        left = min(self.plan.count - first, self.stages.most_views)

        def memory(views: int) -> int:
            return sum(self._memory(first, views, (views * intersections, most)).values())

        return left if memory(left) <= self.usable else max(1, bisect_right(range(1, left), self.usable, key=memory))

    def _draw(self, first: int, views: int, out: Tensor) -> bool:
        """Draw shown views first .. first + views - 1 if they fit, and note their memory; return whether they fit."""
        plan, stats = self.plan, Stats(device=self.stats.device)
        fits = self.budget is None and views == 1  # without a budget one view may take any memory
        if not fits and self._exceeds(self._memory(first, views, (0, 0))):
            return False
        with stats.stage("plan"):
            lists = plan.lists(first, first + views, self.device, self.resident, self.threads)
        cameras = self._native_cameras(first, views)
        with stats.stage("project"):
            work = self.stages.workspace(self.scene, views, stats)
            work.project_images(cameras)
        if not work.order_and_bin(lambda: self._admit(work, first, views) or fits):
            return False
        with stats.stage("composite"):
            self.stages.composite(work, cameras, lists, self.background, out)
        counts = self.stages.counts(work)
        memory = self._memory(first, views, counts)
        stats.work_bytes = sum(memory.values())
        if stats.work_bytes > self.stats.work_bytes:
            self.stats.memory_bytes = memory
        self.stats.add_render(stats)
        self.total = (self.total[0] + counts[0], max(self.total[1], counts[1]))
        return True

    def _admit(self, work: Any, first: int, views: int) -> bool:
        """Return whether the intersections of a chunk fit, now that they are counted."""
        counts = self.stages.counts(work)
        per_view = -(-counts[0] // views)
        # A sixteenth is added for later views, which may have a few more
        self.expected = (per_view + per_view // 16, counts[1] + counts[1] // 16)
        return counts[0] <= _MOST_INTERSECTIONS and not self._exceeds(self._memory(first, views, counts))

    def _exceeds(self, memory: dict[str, int]) -> bool:
        return sum(memory.values()) > self.usable

    def _drop_plan(self) -> None:
        self.plan.release()
        self.resident = False

    def _native_cameras(self, first: int, views: int) -> _core.float32.Cameras:
        """Return the native view of a chunk's cameras, which is valid as long as self.cameras."""
        poses, optics, edges = (t[first:].data_ptr() for t in self.cameras)
        return self.scene.core.Cameras(
            1, views, self.plan.width_px, self.plan.height_px, poses, optics, edges, self.antialiased, *self.aperture
        )

    # The least budget

    def _refuse(self) -> None:
        """Raise InputError that names the least budget."""
        least = max(sum(self._memory(place, 1, self._count_view(place)).values()) for place in range(self.plan.count))
        least += least // (self.stages.reserve - 1) + 1
        raise InputError(
            f"a memory budget of {self.budget} bytes is too small even for one view at a time; this scene "
            f"and panel need {least} bytes or more beside the image"
        )

    def _count_view(self, place: int) -> Counts:
        """Count the intersections of one view, and bound the count of a band.

        Take some Gaussians at a time to save memory.
        """
        cameras = self._native_cameras(place, 1)
        intersections = most = 0
        for first in range(0, self.scene.count, _PROBE):
            some = SceneTensors(*(t[:, first : first + _PROBE] for t in self.scene.tensors))
            work = self.stages.workspace(some, 1, Stats())
            work.project_images(cameras)
            work.order_and_bin(lambda: False)
            counts = self.stages.counts(work)
            intersections, most = intersections + counts[0], most + counts[1]
        return intersections, most
