"""The stages of a render on a CUDA device, float32: what workspace.Workspace is on the CPU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.workspace import Scene, Stats


class CudaWorkspace:
    """Splats, keys and tile lists of one render; every buffer from torch's allocator, all work on its stream."""

    def __init__(self, scene: Scene, images: int, width: int, height: int, colour_order: int, stats: Stats, lens: bool,
                 tile: Any = None):
        n, self.scene, self.images, self.stats = scene.count, scene, images, stats
        self.image = _core.cuda.Image(images, width, height, lens if tile is None else tile)
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

    def order_and_bin(self, admit: Callable[[], bool] = lambda: True) -> bool:
        """admit: asked once `pair_count` is known, whether to go on; returns its answer."""
        scene, cuda, items = self.scene, _core.cuda, self.images * self.scene.count
        with self.stats.stage("order"):
            self.sorted_keys, self.indices = (scene.new(items, dtype=t) for t in (torch.int64, torch.int32))
            temporary = scene.new(cuda.order_bytes(items), dtype=torch.uint8)
            cuda.order(items, self.images, self.keys.data_ptr(), self.sorted_keys.data_ptr(), self.indices.data_ptr(),
                       temporary.data_ptr(), temporary.numel(), self.stream)
        with self.stats.stage("bin"):
            self.ends = scene.new(items, dtype=torch.int64)
            scan = scene.new(cuda.count_bytes(items), dtype=torch.uint8)
            order = (self.sorted_keys.data_ptr(), self.indices.data_ptr(), self.ends.data_ptr())
            cuda.bin_count(self.native, self.image, *order, scan.data_ptr(), scan.numel(), self.stream)
            self.pair_count = count = int(self.ends[-1]) if items else 0
            if not admit():
                return False
            self.pair_buffers = [scene.new(count, dtype=torch.int32) for _ in range(5)]
            self.pairs = cuda.Pairs(count, *(t.data_ptr() for t in self.pair_buffers))
            self.ranges = scene.new(self.image.tiles(), 2, dtype=torch.int64, zero=True)
            sort = scene.new(cuda.fill_bytes(count), dtype=torch.uint8)
            cuda.bin_fill(self.native, self.image, *order, self.pairs, self.ranges.data_ptr(), sort.data_ptr(),
                          sort.numel(), self.stream)
        self.stats.pairs += count
        if self.stats.device is not None:  # reading the count back waits
            self.stats.images += self.images
            self.stats.gaussians_drawn += int((self.keys != -1).sum())
        self.stats.add_buffers(self.splats, self.colours, self.orders, self.keys, self.sorted_keys, self.indices,
                               temporary, self.ends, scan, *self.pair_buffers, self.ranges, sort)
        return True

    def composite_dense(self, cameras: Any, background: Tensor, out: Any) -> None:
        _core.cuda.composite_dense(self.native, self.image, self.ranges.data_ptr(), self.pairs,
                                   background.data_ptr(), out, self.stream)

    def composite_lens(self, lens: Any, background: Tensor, out: Tensor) -> None:
        """out: [H, W, 3], float32 or uint8."""
        floats, bytes_ = (0, out.data_ptr()) if out.dtype == torch.uint8 else (out.data_ptr(), 0)
        _core.cuda.composite_lens(self.native, self.image, self.ranges.data_ptr(), self.pairs, lens,
                                  background.data_ptr(), floats, bytes_, self.stream)

    def dense_backward(self, cameras: Any, background: Tensor, images: Any, gradients: Any,
                       g_cameras: Tensor) -> tuple[list[Tensor], Tensor]:
        """Gradients of the five fields, and of the background in parts [I * parts, 3]; fills g_cameras [B, V, 4, 4]."""
        scene, cuda = self.scene, _core.cuda
        slots = scene.new(self.pair_buffers[0].numel(), cuda.DENSE_SUMS)
        g_background = scene.new(self.image.tiles(), 3)
        cuda.composite_dense_backward(self.native, self.image, self.ranges.data_ptr(), self.pairs, images, gradients,
                                      slots.data_ptr(), g_background.data_ptr(), self.stream)
        out, native = scene.gradients()
        places = scene.new(self.images * scene.count, dtype=torch.int32)
        views = scene.new(self.images, cuda.view_blocks(scene.count), 3, 4, zero=True)
        cuda.project_dense_backward(scene.native(), cameras, self.native, self.sorted_keys.data_ptr(),
                                    self.indices.data_ptr(), self.ends.data_ptr(), places.data_ptr(), slots.data_ptr(),
                                    native, views.data_ptr(), self.stream)
        g_cameras.view(-1, 4, 4)[:, :3] = views.sum(1)
        return out, g_background

    def lens_backward(self, rig: Any, lens: Any, background: Tensor, image: Tensor,
                      g_image: Tensor) -> tuple[list[Tensor], Tensor]:
        """Gradients of the five fields, and of the background in parts [parts, 3]."""
        scene, cuda = self.scene, _core.cuda
        slots = scene.new(self.pair_buffers[0].numel(), cuda.LENS_SUMS + 3 * self.colours.shape[2])
        g_background = scene.new(self.image.tiles(), 3)
        cuda.composite_lens_backward(self.native, self.image, self.ranges.data_ptr(), self.pairs, lens,
                                     image.data_ptr(), g_image.data_ptr(), slots.data_ptr(), g_background.data_ptr(),
                                     self.stream)
        out, native = scene.gradients()
        places = scene.new(scene.count, dtype=torch.int32)
        cuda.project_lens_backward(scene.native(), rig, self.native, self.sorted_keys.data_ptr(),
                                   self.indices.data_ptr(), self.ends.data_ptr(), places.data_ptr(), slots.data_ptr(),
                                   native, self.stream)
        return out, g_background
