"""The stages of a render on a CUDA device: what workspace.Workspace is on the CPU. Forward only, float32."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.workspace import Scene, Stats


class CudaWorkspace:
    """Splats, keys and tile lists of one render; every buffer from torch's allocator, all work on its stream."""

    def __init__(self, scene: Scene, images: int, width: int, height: int, colour_order: int, stats: Stats, lens: bool):
        n, self.scene, self.images, self.stats = scene.count, scene, images, stats
        self.image = _core.cuda.Image(images, width, height, lens)
        self.stream = torch.cuda.current_stream(scene.tensors[0].device).cuda_stream
        self.splats = scene.new(images, n, _core.SPLAT_FIELDS)
        self.colours = scene.new(images, n, colour_order + 1, _core.COLOUR_STRIDE)
        self.orders = scene.new(images, n, dtype=torch.int32)
        self.keys = scene.new(images * n, dtype=torch.int64)
        self.native = scene.core.Splats(images, n, colour_order, self.splats.data_ptr(), self.colours.data_ptr(),
                                        self.orders.data_ptr())

    def project_dense(self, cameras: Any) -> None:
        _core.cuda.project_dense(self.scene.native(), cameras, self.native, self.keys.data_ptr(), self.stream)

    def project_lens(self, rig: Any, lens: Any, tolerance: float) -> float:
        """The largest estimated error of a colour polynomial."""
        error = self.scene.new(1, zero=True)
        _core.cuda.project_lens(self.scene.native(), rig, lens, tolerance, self.native, self.keys.data_ptr(),
                                error.data_ptr(), self.stream)
        return float(error) if self.scene.degree > 0 else 0.0

    def order_and_bin(self) -> None:
        scene, cuda, items = self.scene, _core.cuda, self.images * self.scene.count
        with self.stats.stage("order"):
            sorted_keys, indices = scene.new(items, dtype=torch.int64), scene.new(items, dtype=torch.int32)
            temporary = scene.new(cuda.order_bytes(items), dtype=torch.uint8)
            cuda.order(items, self.images, self.keys.data_ptr(), sorted_keys.data_ptr(), indices.data_ptr(),
                       temporary.data_ptr(), temporary.numel(), self.stream)
        with self.stats.stage("bin"):
            ends = scene.new(items, dtype=torch.int64)
            scan = scene.new(cuda.count_bytes(items), dtype=torch.uint8)
            cuda.bin_count(self.native, self.image, sorted_keys.data_ptr(), indices.data_ptr(), ends.data_ptr(),
                           scan.data_ptr(), scan.numel(), self.stream)
            pairs = int(ends[-1]) if items else 0
            tiles, sorted_tiles, values, self.tile_splats = (scene.new(pairs, dtype=torch.int32) for _ in range(4))
            self.ranges = scene.new(self.image.tiles(), 2, dtype=torch.int64, zero=True)
            sort = scene.new(cuda.fill_bytes(pairs), dtype=torch.uint8)
            cuda.bin_fill(self.native, self.image, sorted_keys.data_ptr(), indices.data_ptr(), ends.data_ptr(), pairs,
                          tiles.data_ptr(), sorted_tiles.data_ptr(), values.data_ptr(), self.tile_splats.data_ptr(),
                          self.ranges.data_ptr(), sort.data_ptr(), sort.numel(), self.stream)
        self.stats.pairs += pairs
        self.stats.add_buffers(self.splats, self.colours, self.orders, self.keys, sorted_keys, indices, temporary, ends,
                               scan, tiles, sorted_tiles, values, self.tile_splats, self.ranges, sort)

    def composite_dense(self, cameras: Any, background: Tensor, out: Any) -> None:
        _core.cuda.composite_dense(self.native, self.image, self.ranges.data_ptr(), self.tile_splats.data_ptr(),
                                   background.data_ptr(), out, self.stream)

    def composite_lens(self, lens: Any, background: Tensor, out: Tensor) -> None:
        """out: [H, W, 3], float32 or uint8."""
        floats, bytes_ = (0, out.data_ptr()) if out.dtype == torch.uint8 else (out.data_ptr(), 0)
        _core.cuda.composite_lens(self.native, self.image, self.ranges.data_ptr(), self.tile_splats.data_ptr(), lens,
                                  background.data_ptr(), floats, bytes_, self.stream)
