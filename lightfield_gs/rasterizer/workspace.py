"""The stages of a render and their buffers, on the CPU; workspace_cuda.py has those of CUDA."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.rasterizer.lenticular_camera import NativeView
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.scene import DenseGradients, Scene, Splats, State, Wanted, floats_or_bytes
from lightfield_gs.rasterizer.stats import Stats, direct_counts
from lightfield_gs.rasterizer.workspace_cuda import CudaWorkspace


class Workspace(Protocol):
    """A render in the making: project_dense or project_lens comes first, then order_and_bin, then a composite or its
    reverse.

    The lists of a render hold pairs: a *pair* is a splat and a tile (on the CPU a band of rows) that it may touch.
    """

    stats: Stats
    splats: Splats
    pair_count: int
    pairs_on_device: Tensor

    def state(self) -> State:
        """What a reverse needs."""

    def project_dense(self, cameras: _core.float32.Cameras) -> None:
        """Makes the splats of I images, one for each camera."""

    def project_lens(self, view: NativeView, quality: Quality) -> float:
        """Makes the splats of one light-field image. Returns the largest estimated error of a colour, in 0..1."""

    def order_and_bin(self, admit: Callable[[], bool] = ...) -> bool:
        """Sorts the splats by depth and lists the pairs. admit: asked, once `pair_count` is known and before memory is
        taken for the lists, whether to go on; returns its answer."""

    def composite_dense(self, cameras: _core.float32.Cameras, background: Tensor, out: _core.float32.Images) -> None:
        """background: [I, 3]; out: the core's DenseImages."""

    def composite_lens(self, view: NativeView, quality: Quality, background: Tensor, out: Tensor) -> None:
        """background: [3]; out: [H, W, 3]."""

    def dense_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        wanted: Wanted,
    ) -> DenseGradients:
        """The gradients that follow from those of images."""

    def lens_backward(
        self, view: NativeView, background: Tensor, image: Tensor, g_image: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Gradients of the five fields, and of the background in parts [parts, 3]."""


class CpuWorkspace:
    """Splats and bins of one render on the CPU, and the stages over them."""

    def __init__(
        self,
        scene: Scene,
        images: int,
        width: int,
        height: int,
        colour_order: int,
        stats: Stats,
        threads: int,
        state: State | None = None,
        compensated: bool = False,
    ):
        self.scene, self.images, self.stats, self.threads = scene, images, stats, threads
        self.width, self.height = width, height
        self.offsets = images * _core.band_count(height) + 1  # where each band's list begins, and the end
        if state is not None:
            state = state.check(images, scene, colour_order, 8 * self.offsets)
            self._use_lists(state.lists)
        self.splats = Splats(scene, images, colour_order, True, compensated, state)

    def _use_lists(self, lists: Tensor) -> None:
        """Takes over lists, bytes: band offsets [I * bands + 1] int64, then the splats of the pairs, int32."""
        self.lists, self.pair_count = lists, (lists.numel() - 8 * self.offsets) // 4
        self.bins = _core.Bins(lists.data_ptr(), lists.data_ptr() + 8 * self.offsets)

    def state(self) -> State:
        return State(self.splats.splats, self.splats.colours, self.lists)

    def project_dense(self, cameras: _core.float32.Cameras) -> None:
        self.scene.core.project_images(self.scene.native(), cameras, self.splats.native, self.threads)

    def project_lens(self, view: NativeView, quality: Quality) -> float:
        return self.scene.core.project_direct(
            self.scene.native(),
            view.rig,
            view.lens,
            quality.native,
            quality.colour_error,
            self.splats.native,
            self.threads,
        )

    def order_and_bin(self, admit: Callable[[], bool] = lambda: True) -> bool:
        scene, core, native, threads = self.scene, self.scene.core, self.splats.native, self.threads
        with self.stats.stage("order"):
            # `order` [I, N] begins with the splats that are drawn, nearest first; there are `drawn` [I] of them
            order = scene.new(self.images, scene.count, dtype=torch.int32)
            drawn = scene.new(self.images, dtype=torch.int64)
            core.order(native, order.data_ptr(), drawn.data_ptr(), threads)
        with self.stats.stage("bin"):
            self.band_offsets = scene.new(self.offsets, dtype=torch.int64)
            bins = _core.Bins(self.band_offsets.data_ptr(), 0)
            self.pair_count = core.bin_count(native, order.data_ptr(), drawn.data_ptr(), self.height, bins, threads)
            if not admit():
                return False
            self._use_lists(scene.new(8 * self.offsets + 4 * self.pair_count, dtype=torch.uint8))
            self.lists[: 8 * self.offsets] = self.band_offsets.view(torch.uint8)
            core.bin_fill(native, order.data_ptr(), drawn.data_ptr(), self.height, self.bins, threads)
        self.pairs_on_device = torch.tensor([self.pair_count])
        self.stats.images += self.images
        self.stats.gaussians_drawn += int(drawn.sum())
        self.stats.add_buffers(*self.splats.buffers(), order, drawn, self.lists)
        return True

    def composite_dense(self, cameras: _core.float32.Cameras, background: Tensor, out: _core.float32.Images) -> None:
        self.stats.count(
            self.scene.core.composite_images(
                self.splats.native, self.bins, cameras, background.data_ptr(), out, self.threads
            )
        )

    def composite_lens(self, view: NativeView, quality: Quality, background: Tensor, out: Tensor) -> None:
        """out: [H, W, 3], of the scene's dtype or uint8."""
        counters = self.scene.core.composite_direct(
            self.splats.native,
            self.bins,
            view.lens,
            quality.native,
            background.data_ptr(),
            *floats_or_bytes(out),
            self.threads,
        )
        self.stats.count(counters)
        if self.stats.device is not None:
            splats = self.splats
            self.stats.pruned = int((splats.splats[..., _core.SPLAT_REACH_INDEX] == _core.PRUNED).sum())
            self.stats.skipped = direct_counts(counters, splats.orders, splats.splats, splats.colour_order)

    def dense_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        wanted: Wanted,
    ) -> DenseGradients:
        core, scene = self.scene.core, self.scene
        first, pairs, g_background = self._gradient_buffers(_core.image_intersection_gradient_size(wanted.absolute))
        core.composite_images_backward(
            self.splats.native,
            self.bins,
            cameras,
            background.data_ptr(),
            images,
            gradients,
            wanted.absolute,
            first.data_ptr(),
            pairs.data_ptr(),
            g_background.data_ptr(),
            self.threads,
        )
        out, native = scene.gradients(zero=True)
        g_cameras = scene.new(self.images, 4, 4, zero=True)
        screen = scene.new(self.images, scene.count, wanted.screen_numbers)
        core.project_images_backward(
            scene.native(),
            cameras,
            self.splats.native,
            first.data_ptr(),
            pairs.data_ptr(),
            native,
            screen.data_ptr() if wanted.screen_numbers else 0,
            wanted.absolute,
            g_cameras.data_ptr(),
            self.threads,
        )
        return DenseGradients(out, g_background, g_cameras, screen)

    def lens_backward(
        self, view: NativeView, background: Tensor, image: Tensor, g_image: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        core, splats = self.scene.core, self.splats
        size = _core.intersection_gradient_size(splats.colour_order, splats.compensations is not None)
        first, pairs, g_background = self._gradient_buffers(size)
        core.composite_direct_backward(
            self.splats.native,
            self.bins,
            view.lens,
            background.data_ptr(),
            image.data_ptr(),
            g_image.data_ptr(),
            first.data_ptr(),
            pairs.data_ptr(),
            g_background.data_ptr(),
            self.threads,
        )
        out, native = self.scene.gradients(zero=True)
        core.project_direct_backward(
            self.scene.native(),
            view.rig,
            view.lens,
            self.splats.native,
            first.data_ptr(),
            pairs.data_ptr(),
            native,
            self.threads,
        )
        return out, g_background

    def _gradient_buffers(self, size: int) -> tuple[Tensor, Tensor, Tensor]:
        """first_pair [I, N], pair gradients [pairs, size], background gradient per band [bands, 3]."""
        first = self.scene.new(self.images, self.scene.count, dtype=torch.int64)
        self.scene.core.first_intersections(self.splats.native, self.height, self.bins, first.data_ptr(), self.threads)
        pairs = self.scene.new(self.pair_count, size, zero=True)
        return first, pairs, self.scene.new(self.images * _core.band_count(self.height), 3, zero=True)


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
    image_render.DenseJob."""
    if scene.device.type == "cuda":
        return CudaWorkspace(
            scene, images, width, height, colour_order, stats, lens, state, compensated=compensated, room=room
        )
    return CpuWorkspace(scene, images, width, height, colour_order, stats, threads, state, compensated)
