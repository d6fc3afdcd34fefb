"""The stages of the method `sorted` on a CUDA device, for some views at a time (csrc/cuda/sorted)."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.encoding.sorted_plan import SortedPlan
from lightfield_gs.rasterizer.scene import Scene, floats_or_bytes
from lightfield_gs.rasterizer.stats import Stats

_MOST_VIEWS, _MOST_NUMBERED = 4096, (1 << 31) - 1  # of a chunk: views; splats, and lists
# Bytes of a chunk: for a splat (a footprint of 32, a colour of 16, a depth), for a pair, and for a list of pairs; and
# what the parts may begin later than the one before ends, with the state
_SPLAT_BYTES, _PAIR_BYTES, _LIST_BYTES, _GAPS = 52, 4, 12, 2048
_STATE = struct.Struct("<Q4xI")  # SortedState: pairs, the long lists, and splats drawn


class CudaStages:
    """What the stages of a chunk take, in bytes, and the stages themselves. See _CpuStages in sorted.py."""

    default_work = 1 << 30
    reserve = 256  # 1 / reserve of the budget is left, for torch rounds every buffer up

    def __init__(self, scene: Scene, plan: SortedPlan):
        self.scene, self.plan = scene, plan
        self.most_views = max(1, min(_MOST_VIEWS, _MOST_NUMBERED // max(scene.count, plan.tiles)))

    def geometry_bytes(self, views: int) -> int:
        return views * self.scene.count * _SPLAT_BYTES

    def binning_bytes(self, views: int, counts: tuple[int, int]) -> int:
        return _PAIR_BYTES * counts[0] + _LIST_BYTES * views * self.plan.tiles + _GAPS

    def workspace(self, scene: Scene, views: int, stats: Stats) -> Any:
        return SortedWorkspace(scene, self.plan, views, stats)

    def counts(self, work: Any) -> tuple[int, int]:
        return work.pair_count, 0

    def composite(
        self, work: Any, cameras: _core.float32.Cameras, lists: tuple[Tensor, Tensor], background: Tensor, out: Tensor
    ) -> None:
        native = _core.SubpixelLists(self.plan.tile, *(t.data_ptr() for t in lists))
        _core.cuda.composite_sorted(work.native, native, background.data_ptr(), *floats_or_bytes(out), work.stream)


class SortedWorkspace:
    """A chunk in the making, with the stages of workspace.Workspace that it takes. Its memory is one buffer, and one
    more for the lists once the host knows how many pairs there are, for which it waits."""

    def __init__(self, scene: Scene, plan: SortedPlan, views: int, stats: Stats):
        self.scene, self.views, self.stats, self.pair_count = scene, views, stats, 0
        self.native = _core.cuda.SortedChunk(
            views=views, gaussians=scene.count, width_px=plan.width_px, height_px=plan.height_px, tile=plan.tile
        )
        self.work = scene.new(self.native.bytes(), dtype=torch.uint8)
        self.native.place(self.work.data_ptr())
        self.stream = torch.cuda.current_stream(scene.device).cuda_stream

    def project_dense(self, cameras: _core.float32.Cameras) -> None:
        _core.cuda.project_sorted(self.native, self.scene.native(), cameras, self.stream)

    def order_and_bin(self, admit: Callable[[], bool]) -> bool:
        """admit: see workspace.Workspace."""
        cuda, stats = _core.cuda, self.stats
        with stats.stage("bin"):
            cuda.count_sorted(self.native, self.stream)
            # The state lies first in the work memory: the number of pairs, and that of splats drawn
            state = self.work[: cuda.SORTED_STATE_BYTES].to("cpu", non_blocking=True)
            counted = torch.cuda.Event()
            counted.record()
            counted.synchronize()
            self.pair_count, drawn = _STATE.unpack(bytes(state.numpy()))
            if not admit():
                return False
            self.ids = self.scene.new(self.pair_count, dtype=torch.int32)
            self.native.place_ids(self.ids.data_ptr())
            cuda.fill_sorted(self.native, self.stream)
        with stats.stage("order"):
            cuda.order_sorted(self.native, self.stream)
        stats.pairs += self.pair_count
        stats.images += self.views
        stats.gaussians_drawn += drawn
        return True
