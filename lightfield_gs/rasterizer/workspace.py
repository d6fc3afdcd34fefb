"""The stages of a render and their buffers, on the CPU; workspace_cuda.py has the CUDA stages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.rasterizer.lenticular_camera import NativeCamera
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.scene import (
    GradientRequest,
    ImageGradients,
    RenderState,
    SceneTensors,
    Splats,
    float_and_byte_addresses,
)
from lightfield_gs.rasterizer.stats import Stats, direct_counts
from lightfield_gs.rasterizer.workspace_cuda import CudaWorkspace


class Workspace(Protocol):
    """The stages of one render: a projection first, then order_and_bin, then a composite or its backward.

    The lists of a render hold intersections. An intersection is a splat and a tile (on the CPU a band of rows) that the
    splat may touch. I: the number of images.
    """

    stats: Stats
    splats: Splats
    intersection_count: int
    intersections_on_device: Tensor

    def state(self) -> RenderState:
        """Return the state that the backward needs."""

    def project_images(self, cameras: _core.float32.Cameras) -> None:
        """Project the Gaussians to the splats of I images, one for each camera."""

    def project_direct(self, camera: NativeCamera, quality: Quality) -> float:
        """Project the Gaussians to the splats of a light-field image; return the largest colour error, 0..1."""

    def order_and_bin(self, admit: Callable[[], bool] = ...) -> bool:
        """Sort the splats by depth and list the intersections.

        Args:
            admit: whether to go on; called once `intersection_count` is known, before memory is made for the lists.

        Returns:
            The answer of admit.
        """

    def composite_images(self, cameras: _core.float32.Cameras, background: Tensor, out: _core.float32.Images) -> None:
        """Composite I images into `out`.

        Args:
            background: [I, 3].
        """

    def composite_direct(self, camera: NativeCamera, quality: Quality, background: Tensor, out: Tensor) -> None:
        """Composite the light-field image into `out` [H, W, 3].

        Args:
            background: [3].
        """

    def images_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        request: GradientRequest,
    ) -> ImageGradients:
        """Return the gradients of the inputs from `gradients`, of the images."""

    def direct_backward(
        self, camera: NativeCamera, background: Tensor, image: Tensor, g_image: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """Return the gradients of the five fields, and of the background in parts [parts, 3]."""


class CpuWorkspace:
    """The stages of one render on the CPU, in float32 or float64; see Workspace."""

    def __init__(
        self,
        scene: SceneTensors,
        images: int,
        width: int,
        height: int,
        colour_order: int,
        stats: Stats,
        threads: int,
        state: RenderState | None = None,
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
        """Use lists of bytes: band offsets [I * bands + 1] int64, then the splats of the intersections, int32."""
        self.lists, self.intersection_count = lists, (lists.numel() - 8 * self.offsets) // 4
        self.bins = _core.Bins(lists.data_ptr(), lists.data_ptr() + 8 * self.offsets)

    def state(self) -> RenderState:
        return RenderState(self.splats.splats, self.splats.colours, self.lists)

    def project_images(self, cameras: _core.float32.Cameras) -> None:
        self.scene.core.project_images(self.scene.native(), cameras, self.splats.native, self.threads)

    def project_direct(self, camera: NativeCamera, quality: Quality) -> float:
        return self.scene.core.project_direct(
            self.scene.native(),
            camera.rig,
            camera.lens,
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
            self.intersection_count = core.bin_count(
                native, order.data_ptr(), drawn.data_ptr(), self.height, bins, threads
            )
            if not admit():
                return False
            self._use_lists(scene.new(8 * self.offsets + 4 * self.intersection_count, dtype=torch.uint8))
            self.lists[: 8 * self.offsets] = self.band_offsets.view(torch.uint8)
            core.bin_fill(native, order.data_ptr(), drawn.data_ptr(), self.height, self.bins, threads)
        self.intersections_on_device = torch.tensor([self.intersection_count])
        self.stats.images += self.images
        self.stats.gaussians_drawn += int(drawn.sum())
        self.stats.add_buffers(*self.splats.buffers(), order, drawn, self.lists)
        return True

    def composite_images(self, cameras: _core.float32.Cameras, background: Tensor, out: _core.float32.Images) -> None:
        self.stats.count(
            self.scene.core.composite_images(
                self.splats.native, self.bins, cameras, background.data_ptr(), out, self.threads
            )
        )

    def composite_direct(self, camera: NativeCamera, quality: Quality, background: Tensor, out: Tensor) -> None:
        """Composite into `out`, of the scene's dtype or uint8; see Workspace."""
        counters = self.scene.core.composite_direct(
            self.splats.native,
            self.bins,
            camera.lens,
            quality.native,
            background.data_ptr(),
            *float_and_byte_addresses(out),
            self.threads,
        )
        self.stats.count(counters)
        if self.stats.device is not None:
            splats = self.splats
            self.stats.pruned = int((splats.splats[..., _core.SPLAT_REACH_INDEX] == _core.PRUNED).sum())
            self.stats.skipped = direct_counts(counters, splats.orders, splats.splats, splats.colour_order)

    def images_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        request: GradientRequest,
    ) -> ImageGradients:
        core, scene = self.scene.core, self.scene
        first, sums, g_background = self._gradient_buffers(_core.image_intersection_gradient_size(request.absolute))
        core.composite_images_backward(
            self.splats.native,
            self.bins,
            cameras,
            background.data_ptr(),
            images,
            gradients,
            request.absolute,
            first.data_ptr(),
            sums.data_ptr(),
            g_background.data_ptr(),
            self.threads,
        )
        out, native = scene.gradients(zero=True)
        g_cameras = scene.new(self.images, 4, 4, zero=True)
        screen = scene.new(self.images, scene.count, request.screen_numbers)
        core.project_images_backward(
            scene.native(),
            cameras,
            self.splats.native,
            first.data_ptr(),
            sums.data_ptr(),
            native,
            screen.data_ptr() if request.screen_numbers else 0,
            request.absolute,
            g_cameras.data_ptr(),
            self.threads,
        )
        return ImageGradients(out, g_background, g_cameras, screen)

    def direct_backward(
        self, camera: NativeCamera, background: Tensor, image: Tensor, g_image: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        core, splats = self.scene.core, self.splats
        size = _core.intersection_gradient_size(splats.colour_order, splats.compensations is not None)
        first, sums, g_background = self._gradient_buffers(size)
        core.composite_direct_backward(
            self.splats.native,
            self.bins,
            camera.lens,
            background.data_ptr(),
            image.data_ptr(),
            g_image.data_ptr(),
            first.data_ptr(),
            sums.data_ptr(),
            g_background.data_ptr(),
            self.threads,
        )
        out, native = self.scene.gradients(zero=True)
        core.project_direct_backward(
            self.scene.native(),
            camera.rig,
            camera.lens,
            self.splats.native,
            first.data_ptr(),
            sums.data_ptr(),
            native,
            self.threads,
        )
        return out, g_background

    def _gradient_buffers(self, size: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return each splat's first intersection [I, N], and gradients: [intersections, size] and [bands, 3]."""
        first = self.scene.new(self.images, self.scene.count, dtype=torch.int64)
        self.scene.core.first_intersections(self.splats.native, self.height, self.bins, first.data_ptr(), self.threads)
        gradients = self.scene.new(self.intersection_count, size, zero=True)
        return first, gradients, self.scene.new(self.images * _core.band_count(self.height), 3, zero=True)


def make_workspace(
    scene: SceneTensors,
    images: int,
    width: int,
    height: int,
    stats: Stats,
    threads: int,
    *,
    direct: bool = False,
    colour_order: int = 0,
    compensated: bool = False,
    state: RenderState | None = None,
    capacity: int | None = None,
) -> Workspace:
    """Return the workspace of the scene's device.

    Args:
        scene: the Gaussians.
        images: how many images there are.
        width: of all images, pixels.
        height: likewise.
        stats: filled with times and counts.
        threads: of the CPU.
        direct: whether the image is a light-field image.
        colour_order: see Splats; and so are compensated and state.
        compensated: see Splats.
        state: see Splats.
        capacity: see ImageRender.
    """
    if scene.device.type == "cuda":
        return CudaWorkspace(
            scene, images, width, height, colour_order, stats, direct, state, compensated=compensated, capacity=capacity
        )
    return CpuWorkspace(scene, images, width, height, colour_order, stats, threads, state, compensated)
