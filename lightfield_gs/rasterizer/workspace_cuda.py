"""The stages of a render on a CUDA device, in float32, and their buffers. See workspace.CpuWorkspace."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from lightfield_gs import _core
from lightfield_gs.rasterizer.lenticular_camera import CELL_PERIOD, NativeCamera
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.splat_shapes import is_drawn
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import (
    CpuWorkspace,
    GradientRequest,
    ImageGradients,
    InputGradients,
    OpticsGradients,
    RenderSize,
    RenderState,
    SceneTensors,
    Splats,
)

_NOT_DRAWN = -1  # key of a splat that is not sorted: all bits
_DEPTH_BITS = 31  # of a key, below the number of the image: csrc/cuda/stages/stages.h
_ALIGNMENT = 256  # bytes, that of memory from CUDA


class CudaWorkspace:
    """The stages of one render on CUDA; see CpuWorkspace. Buffers are of torch's allocator, work is on its stream."""

    def __init__(
        self, scene: SceneTensors, size: RenderSize, stats: Stats, threads: int, state: RenderState | None = None
    ):
        """Allocate the buffers; see CpuWorkspace. No stage uses threads."""
        self.scene, self.images, self.stats, self.items = scene, size.images, stats, size.images * scene.count
        self.capacity = size.capacity
        self.image = _core.cuda.Image(size.images, size.width, size.height, size.direct)
        self.stream = torch.cuda.current_stream(scene.device).cuda_stream
        self.ranges_bytes = 16 * self.image.tiles()  # a range of intersections for each tile
        self.lists_bytes = self.ranges_bytes + 8 * self.items  # these, and a range of gradients for each splat
        if state is None:
            self.keys = scene.new(self.items, dtype=torch.int64)
        else:
            state = state.check(scene, size, self.lists_bytes)
            self._use_lists(state.lists)
        self.splats = Splats(scene, size, size.direct, state)

    def _use_lists(self, lists: Tensor, unsorted: int | None = None) -> None:
        """Use lists, a tensor of bytes.

        They are kept as addresses: making tensors of the parts takes the host longer, and the device would wait. A
        splat's intersections are numbered by slots, in the order of the splats; gradients are written there.

        Args:
            lists: the range of intersections of each tile, [tiles, 2] int64; the range of slots of each splat, [I, N,
                2] int32; slots and splats of the sorted intersections, int32.
            unsorted: address of [4, intersections] int32 that only the filling needs: tiles, sorted tiles, slots and
                their splats.
        """
        self.lists, self.intersection_count = lists, (lists.numel() - self.lists_bytes) // 8
        self.ranges, sorted_slots = lists.data_ptr(), lists.data_ptr() + self.lists_bytes
        self.slot_ranges = self.ranges + self.ranges_bytes
        tiles, sorted_tiles, slots, slot_splats = (
            0 if unsorted is None else unsorted + 4 * self.intersection_count * row for row in range(4)
        )
        self.tile_lists = _core.cuda.Intersections(
            self.intersection_count,
            tiles,
            sorted_tiles,
            slots,
            sorted_slots,
            slot_splats,
            sorted_slots + 4 * self.intersection_count,
            0 if self.capacity is None else self.intersections_on_device.data_ptr(),
        )

    def state(self) -> RenderState:
        return RenderState(self.splats.splats, self.splats.colours, self.lists)

    def project_images(self, cameras: _core.float32.Cameras) -> None:
        _core.cuda.project_images(self.scene.native(), cameras, self.splats.native, self.keys.data_ptr(), self.stream)

    def project_direct(self, camera: NativeCamera, quality: Quality) -> float:
        error = self.scene.new(1, zero=True)
        _core.cuda.project_direct(
            self.scene.native(),
            camera.rig,
            camera.lens,
            quality.colour_error,
            self.splats.native,
            self.keys.data_ptr(),
            error.data_ptr(),
            self.stream,
        )
        return float(error) if self.scene.degree > 0 else 0.0

    def _work(self, *sizes: int) -> tuple[Tensor, list[int]]:
        """Allocate buffers of one stage, of these bytes, as one tensor; return it and their addresses.

        Making several tensors takes the host longer.
        """
        starts = [0]
        for size in sizes:
            starts.append(starts[-1] + (size + _ALIGNMENT - 1) // _ALIGNMENT * _ALIGNMENT)
        work = self.scene.new(starts[-1], dtype=torch.uint8)
        return work, [work.data_ptr() + start for start in starts[:-1]]

    def order_and_bin(self, admit: Callable[[], bool] = lambda: True) -> bool:
        """Sort the splats and list the intersections; see CpuWorkspace.

        The intersections are counted first. Without a capacity the host learns their number while the device sorts.
        """
        scene, cuda, items = self.scene, _core.cuda, self.items
        found = self.intersections_on_device = scene.new(1, dtype=torch.int64, zero=True)
        total_bytes, order_bytes = cuda.count_bytes(items), cuda.order_bytes(items)
        work, (counts, total, sorted_keys, indices, temporary, ends) = self._work(
            4 * items, total_bytes, 8 * items, 4 * items, order_bytes, 8 * items
        )
        with self.stats.stage("bin"):
            cuda.bin_count(self.splats.native, self.image, counts, found.data_ptr(), total, total_bytes, self.stream)
            if self.capacity is None:
                found, counted = found.to("cpu", non_blocking=True), torch.cuda.Event()
                counted.record()
        with self.stats.stage("order"):
            keys = self.keys.data_ptr()
            cuda.order(items, self.images, keys, sorted_keys, indices, temporary, order_bytes, self.stream)
        with self.stats.stage("bin"):
            if self.capacity is None:
                counted.synchronize()
            self.intersection_count = count = int(found) if self.capacity is None else self.capacity
            if not admit():
                return False
            # fill_bytes raises for more intersections than can be numbered, so it comes before other memory
            scratch_bytes = cuda.fill_bytes(items, count)
            more_work, (scratch, unsorted) = self._work(scratch_bytes, 16 * count)
            self._use_lists(scene.new(self.lists_bytes + 8 * count, dtype=torch.uint8), unsorted)
            self.lists[: self.ranges_bytes].zero_()
            cuda.bin_fill(
                self.splats.native,
                self.image,
                indices,
                counts,
                ends,
                self.tile_lists,
                self.ranges,
                self.slot_ranges,
                scratch,
                scratch_bytes,
                self.stream,
            )
        self.stats.intersections += count
        if self.stats.device is not None:  # only then, for reading the count back waits for the device
            self.stats.images += self.images
            self.stats.gaussians_drawn += int((self.keys != -1).sum())
        self.stats.add_buffers(*self.splats.buffers(), self.keys, work, more_work, self.lists)
        return True

    def composite_images(self, cameras: _core.float32.Cameras, background: Tensor, out: _core.float32.Images) -> None:
        _core.cuda.composite_images(
            self.splats.native, self.image, self.ranges, self.tile_lists, background.data_ptr(), out, self.stream
        )

    def composite_direct(self, camera: NativeCamera, quality: Quality, background: Tensor, out: Tensor) -> None:
        """Composite into `out`, float32; see CpuWorkspace. Images of bytes are frames (frame_cuda)."""
        _core.cuda.composite_direct(
            self.splats.native,
            self.image,
            self.ranges,
            self.tile_lists,
            camera.lens,
            background.data_ptr(),
            out.data_ptr(),
            self.stream,
        )

    def composite_images_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        absolute: bool,
    ) -> tuple[Tensor, Tensor]:
        scene, cuda = self.scene, _core.cuda
        slots = scene.new(self.intersection_count, cuda.ABSOLUTE_IMAGE_SUMS if absolute else cuda.IMAGE_SUMS)
        g_background = scene.new(self.image.tiles(), 3)
        cuda.composite_images_backward(
            self.splats.native,
            self.image,
            self.ranges,
            self.tile_lists,
            images,
            gradients,
            absolute,
            slots.data_ptr(),
            g_background.data_ptr(),
            self.stream,
        )
        sums = scene.new(self.images, scene.count, cuda.SPLAT_SUMS)
        cuda.sum_intersections(self.items, self.slot_ranges, absolute, slots.data_ptr(), sums.data_ptr(), self.stream)
        return sums, g_background

    def images_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        request: GradientRequest,
    ) -> ImageGradients:
        sums, g_background = self.composite_images_backward(cameras, background, images, gradients, request.absolute)
        return ImageGradients(*self.fields_backward(cameras, sums, request), g_background)

    def fields_backward(self, cameras: _core.float32.Cameras, sums: Tensor, request: GradientRequest) -> InputGradients:
        return project_images_backward(self.scene, cameras, sums, request)

    def composite_features(self, features: _core.float32.Features, out: Tensor) -> None:
        lists = self.splats.native, self.image, self.ranges, self.tile_lists
        _core.cuda.composite_features(*lists, features, out.data_ptr(), self.stream)

    def composite_median_depth(self, out: Tensor) -> None:
        lists = self.splats.native, self.image, self.ranges, self.tile_lists
        _core.cuda.composite_median_depth(*lists, out.data_ptr(), self.stream)

    def composite_features_backward(self, features: _core.float32.Features, channels: int) -> tuple[Tensor, Tensor]:
        scene, cuda = self.scene, _core.cuda
        slots = scene.new(self.intersection_count, cuda.FEATURE_SUMS)
        sums = scene.new(self.images, scene.count, cuda.SPLAT_SUMS)
        g_features = scene.new(self.images, scene.count, channels)
        cuda.composite_features_backward(
            self.splats.native,
            self.image,
            self.ranges,
            self.tile_lists,
            self.slot_ranges,
            features,
            slots.data_ptr(),
            sums.data_ptr(),
            g_features.data_ptr(),
            self.stream,
        )
        return sums, g_features

    def take(self, splats: Tensor) -> None:
        self.splats.splats.copy_(splats)
        images = torch.arange(self.images, device=splats.device).unsqueeze(1) << _DEPTH_BITS
        depths = splats[..., _core.SPLAT_DEPTH_INDEX].contiguous().view(torch.int32)
        keys = torch.where(is_drawn(splats), images | depths, _NOT_DRAWN)
        self.keys.copy_(keys.flatten())

    def splat_gradients(self, sums: Tensor) -> Tensor:
        power, power_dy, power_dy2, x, x_dy, square, g_depth = sums[..., :7].unbind(-1)  # csrc/math/gradient_sums.h
        _, _, tau, c0 = (self.splats.splats[..., k] for k in _core.SPLAT_SHAPE_INDICES)
        numbers = -x, 2 * tau * power_dy + c0 * x, power, square, -power_dy2, -x_dy, g_depth
        fields = *_core.SPLAT_PLACE_INDICES, *_core.SPLAT_SHAPE_INDICES, _core.SPLAT_DEPTH_INDEX
        gradients = torch.zeros_like(sums)
        gradients[..., list(fields)] = torch.stack(numbers, -1)
        return gradients

    def drop(self, hidden: Tensor) -> None:
        self.splats.drop(hidden)
        self.keys.view(hidden.shape).masked_fill_(hidden, _NOT_DRAWN)

    def direct_backward(
        self, camera: NativeCamera, background: Tensor, image: Tensor, g_image: Tensor, optics: bool = False
    ) -> tuple[list[Tensor], Tensor, OpticsGradients | None]:
        scene, cuda = self.scene, _core.cuda
        extra = 0 if self.splats.compensations is None else _core.COMPENSATION_FIELDS
        slots = scene.new(self.intersection_count, cuda.DIRECT_SUMS + 3 * self.splats.colours.shape[2] + extra)
        g_background = scene.new(self.image.tiles(), 3)
        lens, rig = scene.new(0), scene.new(0)
        if optics:
            lens = scene.new(self.image.tiles(), cuda.LENS_SUMS)
            rig = scene.new(cuda.rig_blocks(scene.count), 16 + _core.RIG_OPTICS, dtype=torch.float64)
        cuda.composite_direct_backward(
            self.splats.native,
            self.image,
            self.ranges,
            self.tile_lists,
            camera.lens,
            image.data_ptr(),
            g_image.data_ptr(),
            slots.data_ptr(),
            g_background.data_ptr(),
            lens.data_ptr() if optics else 0,
            self.stream,
        )
        out, native = scene.gradients(zero=True)
        cuda.project_direct_backward(
            scene.native(),
            camera.rig,
            self.splats.native,
            self.slot_ranges,
            slots.data_ptr(),
            native,
            rig.data_ptr() if optics else 0,
            self.stream,
        )
        return out, g_background, _optics_gradients(lens, rig) if optics else None


def _optics_gradients(lens: Tensor, rig: Tensor) -> OpticsGradients:
    """Return the sums over tiles and blocks, on the CPU.

    Args:
        lens: [tiles, LENS_SUMS], see csrc/cuda/stages/stages.h.
        rig: [blocks, 16 + RIG_OPTICS] float64.
    """
    sums = torch.cat([lens.sum(0, dtype=torch.float64), rig.sum(0)]).cpu()  # one copy, for which the host waits
    places, by_row, by_column, g_rig = sums.split([_core.CELL_SUBPIXELS, 1, 1, rig.shape[1]])
    return OpticsGradients(g_rig, places.view(CELL_PERIOD, CELL_PERIOD, 3), by_row.squeeze(), by_column.squeeze())


def project_images_backward(
    scene: SceneTensors, cameras: _core.float32.Cameras, sums: Tensor, request: GradientRequest
) -> InputGradients:
    """Return the gradients of all inputs but the background, from sums over pixels.

    It is the second half of the backward of images, and needs no result of the forward.

    Args:
        sums: [I, N, SPLAT_SUMS].
    """
    cuda, images = _core.cuda, sums.shape[0]
    out, native = scene.gradients(zero=False)
    # Without the zeros of poses
    parts = [12, 3 * (request.pose_rows - 4), _core.CAMERA_OPTICS if request.optics else 0]
    asked = request.cameras or request.optics
    views = scene.new(images, cuda.camera_blocks(scene.count), sum(parts)) if asked else None
    screen = scene.new(images, scene.count, request.screen_numbers)
    cuda.project_images_backward(
        scene.native(),
        cameras,
        sums.data_ptr(),
        native,
        screen.data_ptr() if request.screen_numbers else 0,
        request.absolute,
        0 if views is None else views.data_ptr(),
        request.optics,
        torch.cuda.current_stream(sums.device).cuda_stream,
    )
    if views is None:
        return out, scene.new(0, request.pose_rows, 4), scene.new(0, _core.CAMERA_OPTICS), screen
    pose, motion, optics = views.sum(1).split(parts, -1)
    if not request.optics:
        optics = scene.new(0, _core.CAMERA_OPTICS)
    rows = functional.pad(pose.view(-1, 3, 4), (0, 0, 0, 1)), functional.pad(motion.view(images, -1, 3), (0, 1))
    return out, torch.cat(rows, 1), optics, screen


Workspace = CpuWorkspace | CudaWorkspace
WORKSPACES: dict[str, type[Workspace]] = {"cpu": CpuWorkspace, "cuda": CudaWorkspace}  # by the type of the device
