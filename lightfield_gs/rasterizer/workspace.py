"""The tensors of a render and its stages on the CPU: checked Gaussians, splats, lists, gradients.

workspace_cuda.py has the stages on CUDA.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import check_tensor
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.lenticular_camera import CELL_PERIOD, NativeCamera
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.stats import Stats, direct_counts

# The numbers of a splat whose gradients are summed, in the order of csrc/stages/stages.h: SplatSum
_SUMMED_FIELDS = (
    *_core.SPLAT_PLACE_INDICES,
    *(_core.SPLAT_SHAPE_INDICES[k] for k in (0, 2, 3, 1)),
    _core.SPLAT_DEPTH_INDEX,
)
_NOT_SEEN = -1.0  # reach of a splat that is not drawn, see csrc/math/footprint.h


def _devices() -> str:
    """Return the devices of this build in words for messages."""
    return "CPU or CUDA" if hasattr(_core, "cuda") else "CPU"


def _stages(tensor: Tensor) -> ModuleType:
    """Return the core's functions for the tensor's precision."""
    if tensor.dtype == torch.float32:
        return _core.float32
    if tensor.dtype == torch.float64:
        return _core.float64
    raise InputError(f"the rasterizer takes float32 or float64 tensors, got {tensor.dtype}")


def float_and_byte_addresses(out: Tensor) -> tuple[int, int]:
    """Return where a composite writes floats, and where bytes: the address of `out` for its type, and 0."""
    return (0, out.data_ptr()) if out.dtype == torch.uint8 else (out.data_ptr(), 0)


class SceneTensors:
    """Checked, contiguous Gaussians [B, N, ...], and their native view."""

    def __init__(self, means: Tensor, quaternions: Tensor, scales: Tensor, opacities: Tensor, sh: Tensor):
        """Check the fields; see ImageArguments. Raises InputError."""
        if means.dim() != 3 or means.shape[-1] != 3:
            raise InputError(f"means must be [scenes, N, 3], got {list(means.shape)}")
        if means.device.type not in ("cpu", "cuda") or means.is_cuda and not hasattr(_core, "cuda"):
            raise InputError(f"this build renders on the {_devices()}; got means on {means.device}: use .cpu()")
        if means.is_cuda and means.dtype != torch.float32:
            raise InputError(f"on CUDA the rasterizer takes float32 tensors, got {means.dtype}")
        batch, count = means.shape[:2]
        if count >= 2**31:
            raise InputError(f"at most 2^31 - 1 Gaussians, got {count}")
        if sh.dim() != 4 or sh.shape[2] not in (1, 4, 9, 16):
            raise InputError(f"sh must be [scenes, N, 1 | 4 | 9 | 16, 3], got {list(sh.shape)}")
        self.core, self.batch, self.count = _stages(means), batch, count
        self.dtype, self.device = means.dtype, means.device
        self.degree = {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[2]]
        self.tensors = [
            check_tensor(name, tensor, (batch, count, *shape), self.dtype, self.device)
            for name, tensor, shape in (
                ("means", means, (3,)),
                ("quaternions", quaternions, (4,)),
                ("scales", scales, (3,)),
                ("opacities", opacities, ()),
                ("sh", sh, (sh.shape[2], 3)),
            )
        ]

    @classmethod
    def of_splats(cls, splats: Tensor, batch: int) -> SceneTensors:
        """Return what without_values returns, for splats [I, N, SPLAT_FIELDS] of `batch` scenes; raise InputError."""
        if splats.dim() != 3 or splats.shape[2] != _core.SPLAT_FIELDS:
            raise InputError(f"splats must be [images, N, {_core.SPLAT_FIELDS}], got {list(splats.shape)}")
        scene = cls.__new__(cls)
        scene.core, scene.batch, scene.count, scene.tensors = _stages(splats), batch, splats.shape[1], []
        scene.dtype, scene.device, scene.degree = splats.dtype, splats.device, 0
        return scene

    def without_values(self) -> SceneTensors:
        """Return a copy that keeps no tensors alive: enough for a composite and its backward, which read splats."""
        other = copy.copy(self)
        other.tensors = []
        return other

    def native(self) -> _core.float32.Gaussians:
        """Return the addresses for the core, which are valid as long as this object."""
        return self.core.Gaussians(self.count, self.degree, *(t.data_ptr() for t in self.tensors))

    def new(self, *shape: int, dtype: torch.dtype | None = None, zero: bool = False) -> Tensor:
        """Allocate a tensor on the device of the Gaussians, of their dtype unless given; without values, or all 0."""
        make = torch.zeros if zero else torch.empty
        return make(shape, dtype=dtype or self.dtype, device=self.device)

    def gradients(self, zero: bool) -> tuple[list[Tensor], _core.float32.Gaussians]:
        """Allocate the gradients of the five fields, all 0 or without values; return them and the core's view."""
        grads = [torch.zeros_like(t) if zero else torch.empty_like(t) for t in self.tensors]
        return grads, self.core.Gaussians(self.count, self.degree, *(g.data_ptr() for g in grads))


class RenderSize(NamedTuple):
    """The images of a render, and the sizes of its buffers.

    Attributes:
        images: Number of images.
        width: Width of all images, pixels.
        height: Likewise.
        direct: Whether the image is a light-field image.
        colour_order: Highest order of the polynomials for the colours of a light field over the rig; 0: one colour
            each.
        compensated: Whether opacities change over the rig, by the compensation of anti-aliasing or of an aperture.
        capacity: See ImageRender.
    """

    images: int
    width: int
    height: int
    direct: bool = False
    colour_order: int = 0
    compensated: bool = False
    capacity: int | None = None


class RenderState(NamedTuple):
    """The state that a render leaves to its backward.

    Attributes:
        splats: [I, N, SPLAT_FIELDS].
        colours: [I, N, order + 1, COLOUR_STRIDE].
        lists: The splats of each tile as bytes, in a layout of the device's own.
    """

    splats: Tensor
    colours: Tensor
    lists: Tensor

    @classmethod
    def shapes(cls, images: int, count: int, colour_order: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the shapes of splats and colours."""
        return (images, count, _core.SPLAT_FIELDS), (images, count, colour_order + 1, _core.COLOUR_STRIDE)

    def check(self, scene: SceneTensors, size: RenderSize, least_bytes: int) -> RenderState:
        """Return the state contiguous. Raises InputError if it is not of such a render."""
        splats, colours = (
            check_tensor(f"state: {name}", t, shape, scene.dtype, scene.device)
            for name, t, shape in zip(self._fields, self, self.shapes(size.images, scene.count, size.colour_order))
        )
        if self.lists.dtype != torch.uint8 or self.lists.dim() != 1 or self.lists.numel() < least_bytes:
            raise InputError(
                f"state: lists must be {least_bytes} bytes or more, got {list(self.lists.shape)} of {self.lists.dtype}"
            )
        return RenderState(splats, colours, self.lists.contiguous())


class Splats:
    """The projected Gaussians of `images` images: written by `project`, read by all later stages."""

    def __init__(self, scene: SceneTensors, size: RenderSize, with_orders: bool, state: RenderState | None):
        """Allocate the splats, or take them from `state`.

        Args:
            scene: the Gaussians.
            size: of the render.
            with_orders: whether each Gaussian may have a lower order of colours of its own.
            state: left by an earlier render.
        """
        images, n, self.colour_order = size.images, scene.count, size.colour_order
        if state is None:
            shapes = RenderState.shapes(images, n, self.colour_order)
            self.splats, self.colours = (scene.new(*shape) for shape in shapes)
        else:
            self.splats, self.colours = state.splats, state.colours
        self.orders = scene.new(images, n if with_orders else 0, dtype=torch.int32)
        self.compensations = scene.new(n, _core.COMPENSATION_FIELDS) if size.compensated else None
        self.native = scene.core.Splats(
            images,
            n,
            self.colour_order,
            self.splats.data_ptr(),
            self.colours.data_ptr(),
            self.orders.data_ptr(),
            0 if self.compensations is None else self.compensations.data_ptr(),
        )

    def drop(self, hidden: Tensor) -> None:
        """Mark splats as not drawn. hidden: [I, N] bool."""
        self.splats[..., _core.SPLAT_REACH_INDEX].masked_fill_(hidden, _NOT_SEEN)

    def buffers(self) -> list[Tensor]:
        """Return all tensors, for counting their memory."""
        extra = [] if self.compensations is None else [self.compensations]
        return [self.splats, self.colours, self.orders, *extra]


class GradientRequest(NamedTuple):
    """The gradients of ordinary images on request, in addition to the five fields and the background.

    Attributes:
        screen_numbers: 0; 2 for the projected means, in 1 / pixels; 4 for these and the sums of absolute values.
        cameras: Whether the gradient of world_to_camera is asked for.
        pose_rows: Of each pose; ImageInputs knows.
        optics: Whether the gradients of intrinsics and limits are asked for, with that of world_to_camera.
    """

    screen_numbers: int = 0
    cameras: bool = True
    pose_rows: int = 4
    optics: bool = False

    @property
    def absolute(self) -> bool:
        """Whether the sums of absolute values are asked for."""
        return self.screen_numbers == 4


class ImageGradients(NamedTuple):
    """Gradients of ordinary images.

    Attributes:
        fields: Gradients of the five fields.
        cameras: [I, pose_rows, 4], or [0, pose_rows, 4].
        optics: Gradients of intrinsics, then limits, [I, CAMERA_OPTICS], or [0, CAMERA_OPTICS].
        screen: Gradients of the projected means, [I, N, screen_numbers].
        background_parts: [I * parts, 3].
    """

    fields: list[Tensor]
    cameras: Tensor
    optics: Tensor
    screen: Tensor
    background_parts: Tensor


InputGradients = tuple[list[Tensor], Tensor, Tensor, Tensor]  # the first four of ImageGradients


class OpticsGradients(NamedTuple):
    """Gradients of the camera of a light-field image, float64.

    Those of the lens are sums over sub-pixels of g, the gradient of the normalized offset of a sub-pixel's camera.

    Attributes:
        rig: [16 + RIG_OPTICS], of world_to_camera and then as csrc/math/projection.h lists Optic.
        places: [CELL_PERIOD, CELL_PERIOD, 3], sums of g by row and column modulo CELL_PERIOD, and by image channel.
        by_row: [], the sum of g times the row of the pixel.
        by_column: [], likewise times the column.
    """

    rig: Tensor
    places: Tensor
    by_row: Tensor
    by_column: Tensor


class CpuWorkspace:
    """The stages of one render on the CPU: a projection first, then order_and_bin, then a composite or its backward.

    The lists of a render hold intersections. An intersection is a splat and a tile (on the CPU a band of rows) that the
    splat may touch. I: the number of images. CudaWorkspace has the same methods.
    """

    def __init__(
        self, scene: SceneTensors, size: RenderSize, stats: Stats, threads: int, state: RenderState | None = None
    ):
        """Allocate the buffers.

        Args:
            scene: the Gaussians.
            size: of the render.
            stats: filled with times and counts.
            threads: of the CPU.
            state: left by an earlier render, in place of project, order and bin.
        """
        self.scene, self.images, self.stats, self.threads = scene, size.images, stats, threads
        self.width, self.height = size.width, size.height
        self.offsets = size.images * _core.band_count(size.height) + 1  # where each band's list begins, and the end
        if state is not None:
            state = state.check(scene, size, 8 * self.offsets)
            self._use_lists(state.lists)
        self.splats = Splats(scene, size, True, state)

    def _use_lists(self, lists: Tensor) -> None:
        """Use lists of bytes: band offsets [I * bands + 1] int64, then the splats of the intersections, int32."""
        self.lists, self.intersection_count = lists, (lists.numel() - 8 * self.offsets) // 4
        self.bins = _core.Bins(lists.data_ptr(), lists.data_ptr() + 8 * self.offsets)

    def state(self) -> RenderState:
        """Return the state that the backward needs."""
        return RenderState(self.splats.splats, self.splats.colours, self.lists)

    def project_images(self, cameras: _core.float32.Cameras) -> None:
        """Project the Gaussians to the splats of I images, one for each camera."""
        self.scene.core.project_images(self.scene.native(), cameras, self.splats.native, self.threads)

    def project_direct(self, camera: NativeCamera, quality: Quality) -> float:
        """Project the Gaussians to the splats of a light-field image; return the largest colour error, 0..1."""
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
        """Sort the splats by depth and list the intersections.

        Args:
            admit: whether to go on; called once `intersection_count` is known, before memory is made for the lists.

        Returns:
            The answer of admit.
        """
        scene, core, native, threads = self.scene, self.scene.core, self.splats.native, self.threads
        # `order` [I, N] begins with the splats that are drawn, nearest first; there are `drawn` [I] of them
        order, drawn = scene.new(self.images, scene.count, dtype=torch.int32), scene.new(self.images, dtype=torch.int64)
        self.band_offsets = scene.new(self.offsets, dtype=torch.int64)
        with self.stats.stage("order"):
            core.order(native, order.data_ptr(), drawn.data_ptr(), threads)
        with self.stats.stage("bin"):
            bins = _core.Bins(self.band_offsets.data_ptr(), 0)
            self.intersection_count = core.bin_count(
                native, order.data_ptr(), drawn.data_ptr(), self.height, bins, threads
            )
            if not admit():
                return False
            self._use_lists(scene.new(8 * self.offsets + 4 * self.intersection_count, dtype=torch.uint8))
            self.lists[: 8 * self.offsets] = self.band_offsets.view(torch.uint8)
            core.bin_fill(native, order.data_ptr(), drawn.data_ptr(), self.height, self.bins, threads)
            buffers = [*self.splats.buffers(), order, drawn, self.lists]
        self.intersections_on_device = torch.tensor([self.intersection_count])
        self.stats.images += self.images
        self.stats.gaussians_drawn += int(drawn.sum())
        self.stats.add_buffers(*buffers)
        return True

    def composite_images(self, cameras: _core.float32.Cameras, background: Tensor, out: _core.float32.Images) -> None:
        """Composite I images into `out`.

        Args:
            background: [I, 3].
        """
        self.stats.count(
            self.scene.core.composite_images(
                self.splats.native, self.bins, cameras, background.data_ptr(), out, self.threads
            )
        )

    def composite_direct(self, camera: NativeCamera, quality: Quality, background: Tensor, out: Tensor) -> None:
        """Composite the light-field image into `out` [H, W, 3], of the scene's dtype or uint8.

        Args:
            background: [3].
        """
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
        """Return the gradients of the inputs from `gradients`, of the images."""
        first, found, g_background = self._composite_backward(cameras, background, images, gradients, request.absolute)
        return ImageGradients(*self._fields_backward(cameras, first.data_ptr(), found, request), g_background)

    def composite_images_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        absolute: bool,
    ) -> tuple[Tensor, Tensor]:
        """Run the first half of images_backward.

        Return sums over the intersections of each splat [I, N, SPLAT_FIELDS], for fields_backward, and the background's
        gradient in parts [I * parts, 3].
        """
        first, found, g_background = self._composite_backward(cameras, background, images, gradients, absolute)
        sums = self.scene.new(self.images, self.scene.count, _core.SPLAT_FIELDS)
        self.scene.core.sum_intersections(
            self.splats.native, self.height, first.data_ptr(), found.data_ptr(), absolute, sums.data_ptr(), self.threads
        )
        return sums, g_background

    def fields_backward(self, cameras: _core.float32.Cameras, sums: Tensor, request: GradientRequest) -> InputGradients:
        """Run the second half of images_backward: gradients of all inputs but the background."""
        return self._fields_backward(cameras, 0, sums, request)

    def _composite_backward(
        self,
        cameras: _core.float32.Cameras,
        background: Tensor,
        images: _core.float32.Images,
        gradients: _core.float32.Images,
        absolute: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return each splat's first intersection, the gradients of intersections, and the background's in parts."""
        first, found, g_background = self._gradient_buffers(_core.image_intersection_gradient_size(absolute))
        self.scene.core.composite_images_backward(
            self.splats.native,
            self.bins,
            cameras,
            background.data_ptr(),
            images,
            gradients,
            absolute,
            first.data_ptr(),
            found.data_ptr(),
            g_background.data_ptr(),
            self.threads,
        )
        return first, found, g_background

    def _fields_backward(
        self, cameras: _core.float32.Cameras, first: int, found: Tensor, request: GradientRequest
    ) -> InputGradients:
        """Take the gradients `found` of intersections, or of splats if the address `first` is 0, to the inputs."""
        scene = self.scene
        out, native = scene.gradients(zero=True)
        g_cameras = scene.new(self.images, request.pose_rows, 4, zero=True)
        g_optics = scene.new(self.images if request.optics else 0, _core.CAMERA_OPTICS)
        screen = scene.new(self.images, scene.count, request.screen_numbers)
        scene.core.project_images_backward(
            scene.native(),
            cameras,
            self.splats.native,
            first,
            found.data_ptr(),
            native,
            screen.data_ptr() if request.screen_numbers else 0,
            request.absolute,
            g_cameras.data_ptr(),
            g_optics.data_ptr() if request.optics else 0,
            self.threads,
        )
        return out, g_cameras, g_optics, screen

    def composite_features(self, features: _core.float32.Features, out: Tensor) -> None:
        """Blend features into `out` [I, H, W, D]."""
        core, size = self.scene.core, (self.width, self.height)
        core.composite_features(self.splats.native, self.bins, *size, features, out.data_ptr(), self.threads)

    def composite_median_depth(self, out: Tensor) -> None:
        """Write the depth at which half of the light is left into `out` [I, H, W]."""
        core, size = self.scene.core, (self.width, self.height)
        core.composite_median_depth(self.splats.native, self.bins, *size, out.data_ptr(), self.threads)

    def composite_features_backward(self, features: _core.float32.Features, channels: int) -> tuple[Tensor, Tensor]:
        """Return the sums of fields_backward, and the gradients of features [I, N, channels]."""
        scene = self.scene
        first = self._first_intersections()
        found = scene.new(self.intersection_count, _core.FEATURE_GRADIENT)
        sums = scene.new(self.images, scene.count, _core.SPLAT_FIELDS)
        g_features = scene.new(self.images, scene.count, channels)
        scene.core.composite_features_backward(
            self.splats.native,
            self.bins,
            self.width,
            self.height,
            features,
            self.intersection_count,
            first.data_ptr(),
            found.data_ptr(),
            sums.data_ptr(),
            g_features.data_ptr(),
            self.threads,
        )
        return sums, g_features

    def take(self, splats: Tensor) -> None:
        """Use splats [I, N, SPLAT_FIELDS] in place of a projection."""
        self.splats.splats.copy_(splats)

    def splat_gradients(self, sums: Tensor) -> Tensor:
        """Return the gradients of the splats' numbers [I, N, SPLAT_FIELDS] from sums of composites."""
        gradients = torch.zeros_like(sums)
        gradients[..., list(_SUMMED_FIELDS)] = sums[..., : len(_SUMMED_FIELDS)]
        return gradients

    def drop(self, hidden: Tensor) -> None:
        """Do not draw splats: before order_and_bin. hidden: [I, N] bool."""
        self.splats.drop(hidden)

    def direct_backward(
        self, camera: NativeCamera, background: Tensor, image: Tensor, g_image: Tensor, optics: bool = False
    ) -> tuple[list[Tensor], Tensor, OpticsGradients | None]:
        """Return the gradients of the five fields, of the background in parts [parts, 3], and of the camera.

        optics: Whether the gradients of the camera are asked for; else they are None.
        """
        core, splats = self.scene.core, self.splats
        g_rig = torch.empty(16 + _core.RIG_OPTICS, dtype=torch.float64)
        g_offsets = self.scene.new(*image.shape) if optics else None
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
            0 if g_offsets is None else g_offsets.data_ptr(),
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
            g_rig.data_ptr() if optics else 0,
            self.threads,
        )
        return out, g_background, None if g_offsets is None else OpticsGradients(g_rig, *_lens_sums(g_offsets))

    def _gradient_buffers(self, size: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return each splat's first intersection [I, N], and gradients: [intersections, size] and [bands, 3]."""
        gradients = self.scene.new(self.intersection_count, size, zero=True)
        g_background = self.scene.new(self.images * _core.band_count(self.height), 3, zero=True)
        return self._first_intersections(), gradients, g_background

    def _first_intersections(self) -> Tensor:
        """Return the number of each splat's first intersection [I, N]."""
        first = self.scene.new(self.images, self.scene.count, dtype=torch.int64)
        self.scene.core.first_intersections(self.splats.native, self.height, self.bins, first.data_ptr(), self.threads)
        return first


def _lens_sums(g_offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return places, by_row and by_column of OpticsGradients from the gradient of each sub-pixel, [H, W, 3]."""
    rows, columns = (g_offsets.sum(axes, dtype=torch.float64) for axes in ((1, 2), (0, 2)))
    starts = [(i, j) for i in range(CELL_PERIOD) for j in range(CELL_PERIOD)]
    parts = [g_offsets[i::CELL_PERIOD, j::CELL_PERIOD].sum((0, 1), dtype=torch.float64) for i, j in starts]
    by_row, by_column = (sums @ torch.arange(len(sums), dtype=torch.float64) for sums in (rows, columns))
    return torch.stack(parts).view(CELL_PERIOD, CELL_PERIOD, 3), by_row, by_column
