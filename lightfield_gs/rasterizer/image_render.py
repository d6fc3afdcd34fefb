"""Ordinary images without autograd: their stages, their gradients, and many images in chunks."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.arrays import check_tensor
from lightfield_gs.base.device import device_guard
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.lenticular_camera import PINHOLE, Aperture
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import (
    GradientRequest,
    ImageGradients,
    InputGradients,
    RenderSize,
    RenderState,
    SceneTensors,
)
from lightfield_gs.rasterizer.workspace_cuda import WORKSPACES, project_images_backward
from lightfield_gs.scene.cameras import pose_rows

# Memory in addition to the images: a chunk of cameras takes about this much; a larger camera is a chunk by itself
CHUNK_BYTES = 1 << 29
# Numbers for a splat in one image: its fields, its colour, its index in the order, and a few intersections
_SPLAT_NUMBERS = 48


class ImageArguments(NamedTuple):
    """The arguments of the operators of ordinary images: B scenes of N Gaussians, each seen by V cameras.

    All tensors are float32, or on the CPU all float64.

    Attributes:
        means: [B, N, 3], scene units.
        quaternions: [B, N, 4], wxyz, of any length but 0.
        scales: [B, N, 3], > 0, scene units.
        opacities: [B, N], in (0, 1].
        sh: [B, N, K, 3], spherical harmonics, K = 1, 4, 9 or 16.
        background: [B, V, 3].
        world_to_camera: [B, V, 4, 4], or of rolling shutters [B, V, 6, 4], see Cameras.poses.
        intrinsics: [B, V, 4], fx, fy, cx and cy in pixels.
        limits: [B, V, 5], of the projection's Jacobian, or the lens; see Cameras.limits.
        width, height: Size of all images, 1..65536 pixels.
        antialiased: See images.render.
        screen: [B, V, N, 2 or 4], whose gradient is asked for; see images.render. No stage reads it.
        model: of all cameras, see Cameras.model_number.
    """

    means: Tensor
    quaternions: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor
    background: Tensor
    world_to_camera: Tensor
    intrinsics: Tensor
    limits: Tensor
    width: int
    height: int
    antialiased: bool = False
    screen: Tensor | None = None
    model: int = 0


class ImageBuffers(NamedTuple):
    """image [B, V, H, W, 3], alpha and depth [B, V, H, W]; or their gradients, where None stands for zeros."""

    image: Tensor
    alpha: Tensor | None
    depth: Tensor | None


class ImageInputs:
    """Checked Gaussians and cameras of a render of ordinary images."""

    pose_rows = 4  # of each camera; 6 of rolling shutters

    def __init__(
        self,
        fields: Sequence[Tensor],
        cameras: Sequence[Tensor],
        width: int,
        height: int,
        antialiased: bool = False,
        model: int = 0,
        *,
        aperture: Aperture = PINHOLE,
    ):
        """Check the tensors.

        Args:
            fields: means, quaternions, scales, opacities and sh; see ImageArguments.
            cameras: world_to_camera, intrinsics and limits; see ImageArguments.
            width: of all images, 1..65536 pixels.
            height: likewise.
            antialiased: see images.render.
            model: see ImageArguments.
            aperture: of all cameras.

        Raises:
            InputError: for other shapes, types, devices or sizes.
        """
        self.scene = scene = SceneTensors(*fields)
        world_to_camera, intrinsics, limits = cameras
        if world_to_camera.dim() != 4:
            raise InputError(f"world_to_camera must be [scenes, cameras, 4, 4], got {list(world_to_camera.shape)}")
        if not (1 <= width <= 65536 and 1 <= height <= 65536):
            raise InputError(f"image size must be 1..65536 pixels each way, got {width} x {height}")
        lead = (scene.batch, world_to_camera.shape[1])
        self._set_size(lead, width, height)
        self.pose_rows = rows = pose_rows(model)
        self._camera_tensors = [
            check_tensor("world_to_camera", world_to_camera, (*lead, rows, 4), scene.dtype, scene.device),
            check_tensor("intrinsics", intrinsics, (*lead, 4), scene.dtype, scene.device),
            check_tensor("limits", limits, (*lead, 5), scene.dtype, scene.device),
        ]
        poses, optics, edges = (t.data_ptr() for t in self._camera_tensors)
        self.cameras = scene.core.Cameras(
            *lead, width, height, poses, optics, edges, antialiased, *aperture, model=model
        )

    @classmethod
    def of_splats(cls, splats: Tensor, scenes: int, width: int, height: int) -> ImageInputs:
        """Return what without_values returns, for splats [scenes * cameras, N, SPLAT_FIELDS]. Raise InputError."""
        inputs = cls.__new__(cls)
        inputs.scene = scene = SceneTensors.of_splats(splats, scenes)
        inputs._set_size((scenes, splats.shape[0] // max(scenes, 1)), width, height)
        inputs._camera_tensors = []
        inputs.cameras = scene.core.Cameras(*inputs.lead, width, height, 0, 0, 0)
        return inputs

    def _set_size(self, lead: tuple[int, int], width: int, height: int) -> None:
        """Set the shapes of image, alpha and depth. lead: scenes and cameras of each."""
        self.lead, self.images, self.width, self.height = lead, lead[0] * lead[1], width, height
        self.shapes = (*lead, height, width, 3), (*lead, height, width), (*lead, height, width)

    def without_values(self) -> ImageInputs:
        """Return a copy that keeps no tensors alive: see SceneTensors.without_values."""
        other = copy.copy(self)
        other.scene, other._camera_tensors = self.scene.without_values(), []
        return other

    def backward_from_sums(self, sums: Tensor, request: GradientRequest) -> InputGradients:
        """Return the gradients of all inputs but the background; CUDA only.

        Args:
            sums: Result of ImageRender.backward_sums.
        """
        with device_guard(self.scene.device):
            return project_images_backward(self.scene, self.cameras, sums, self.completed(request))

    def completed(self, request: GradientRequest) -> GradientRequest:
        """Return the request with the rows of these poses."""
        return request._replace(pose_rows=self.pose_rows)


class ImageRender:
    """A render of ordinary images after project, order and bin, ready for the composite or its backward."""

    def __init__(
        self,
        inputs: ImageInputs,
        background: Tensor | None,
        *,
        stats: Stats | None = None,
        threads: int | None = None,
        state: RenderState | None = None,
        capacity: int | None = None,
        hidden: Callable[[Tensor], Tensor] | None = None,
        splats: Tensor | None = None,
        listed: bool = True,
    ):
        """Run project, order and bin, or take their results from `state`.

        Args:
            inputs: Gaussians and cameras.
            background: [B, V, 3]; None if no image is drawn.
            stats: filled with times and counts.
            threads: of the CPU; None: torch's.
            state: the state of an earlier render of the same inputs.
            capacity: on CUDA, for how many intersections of tiles and splats memory is made. Then nothing waits for
                the device; if `intersections_on_device` is larger, the images are wrong. None: the host waits for the
                number.
            hidden: which splats are not drawn, [I, N] bool, from the splats [I, N, SPLAT_FIELDS].
            splats: [I, N, SPLAT_FIELDS], in place of a projection, which would also write colours.
            listed: whether order and bin run; without them `splats` is all that there is.

        Raises:
            InputError: for a background or state that does not fit the inputs.
        """
        self.inputs, self.scene, self.stats = inputs, inputs.scene, stats or Stats()
        like = self.scene.dtype, self.scene.device
        self.background = (
            None if background is None else check_tensor("background", background, (*inputs.lead, 3), *like)
        )
        with device_guard(self.scene.device):
            size = RenderSize(inputs.images, inputs.width, inputs.height, capacity=capacity)
            make = WORKSPACES[self.scene.device.type]
            self.work = make(self.scene, size, self.stats, threads or torch.get_num_threads(), state)
            if state is None:
                with self.stats.stage("project"):
                    if splats is None:
                        self.work.project_images(inputs.cameras)
                    else:
                        self.work.take(splats)
                    if hidden is not None:
                        self.work.drop(hidden(self.work.splats.splats))
                if listed:
                    self.work.order_and_bin()

    @classmethod
    def from_arguments(cls, arguments: ImageArguments, *, aperture: Aperture = PINHOLE, **options: Any) -> ImageRender:
        """Return the render of an operator's arguments. options: of ImageRender."""
        fields, cameras, size = arguments[:5], arguments[6:9], arguments[9:11]
        inputs = ImageInputs(fields, cameras, *size, arguments.antialiased, arguments.model, aperture=aperture)
        return cls(inputs, arguments.background, **options)

    @property
    def intersections_on_device(self) -> Tensor:
        """[1] int64: the number of intersections; if larger than the capacity, the images are wrong."""
        return self.work.intersections_on_device

    @property
    def splats(self) -> Tensor:
        """The projected Gaussians of each image, [B * V, N, SPLAT_FIELDS]."""
        return self.work.splats.splats

    def draw(self, out: ImageBuffers | None = None) -> ImageBuffers:
        """Return the images.

        Args:
            out: Contiguous memory for some outputs; None stands for new memory.
        """
        scene, given = self.scene, out or (None, None, None)
        with device_guard(scene.device), self.stats.stage("composite"):
            image, alpha, depth = (scene.new(*s) if t is None else t for t, s in zip(given, self.inputs.shapes))
            native = scene.core.Images(image.data_ptr(), alpha.data_ptr(), depth.data_ptr())
            self.work.composite_images(self.inputs.cameras, self._behind(), native)
        return ImageBuffers(image, alpha, depth)

    def draw_features(self, features: Tensor) -> Tensor:
        """Return features blended by the weights of the image, [B, V, H, W, D].

        Args:
            features: [B, N, D], or [B, V, N, D].

        Raises:
            InputError: for features of other shapes, types or devices.
        """
        features, native = self._features(features)
        out = self.scene.new(*self.inputs.shapes[1], features.shape[-1])
        with device_guard(self.scene.device), self.stats.stage("composite"):
            self.work.composite_features(native, out)
        return out

    def features_backward(self, features: Tensor, image: Tensor, g_image: Tensor) -> tuple[Tensor, Tensor]:
        """Return sums for fields_backward, and the gradients of features.

        Args:
            features: as of draw_features.
            image: what that returned.
            g_image: its gradient.

        Raises:
            InputError: for tensors of other shapes, types or devices.
        """
        channels, like = features.shape[-1], (self.scene.dtype, self.scene.device)
        shape = (*self.inputs.shapes[1], channels)
        held = check_tensor("image", image, shape, *like), check_tensor("g_image", g_image, shape, *like)
        features, native = self._features(features, *held)
        with device_guard(self.scene.device):
            sums, found = self.work.composite_features_backward(native, channels)
        found = found.view(*self.inputs.lead, self.scene.count, channels)
        return sums, found if features.dim() == 4 else found.sum(1)

    def median_depth(self) -> Tensor:
        """Return the depth at which half of the light is left, [B, V, H, W]."""
        out = self.scene.new(*self.inputs.shapes[1])
        with device_guard(self.scene.device), self.stats.stage("composite"):
            self.work.composite_median_depth(out)
        return out

    def _features(self, features: Tensor, *images: Tensor) -> tuple[Tensor, _core.float32.Features]:
        """Return features contiguous, and the core's view of them and of their images. Raises InputError."""
        lead = self.inputs.lead if features.dim() == 4 else self.inputs.lead[:1]
        shape = (*lead, self.scene.count, features.shape[-1])
        features = check_tensor("features", features, shape, self.scene.dtype, self.scene.device)
        per_row = 1 if features.dim() == 4 else max(self.inputs.lead[1], 1)
        addresses = (t.data_ptr() for t in (features, *images))
        return features, self.scene.core.Features(features.shape[-1], per_row, *addresses)

    def _behind(self) -> Tensor:
        assert self.background is not None, "only renders with a background draw images"
        return self.background

    def backward(self, images: ImageBuffers, gradients: ImageBuffers, request: GradientRequest) -> ImageGradients:
        """Return the gradients of the inputs.

        Args:
            images: what draw() returned.
            gradients: of these images.
            request: which gradients.
        """
        native, native_gradients = self._natives(images, gradients)
        with device_guard(self.scene.device):
            return self.work.images_backward(
                self.inputs.cameras, self._behind(), native, native_gradients, self.inputs.completed(request)
            )

    def backward_sums(self, images: ImageBuffers, gradients: ImageBuffers, absolute: bool) -> tuple[Tensor, Tensor]:
        """Run the first half of backward().

        Returns:
            Sums over the intersections of each splat [I, N, SPLAT_FIELDS], for fields_backward; and the gradient of the
            background in parts [I * parts, 3].
        """
        native, native_gradients = self._natives(images, gradients)
        with device_guard(self.scene.device):
            return self.work.composite_images_backward(
                self.inputs.cameras, self._behind(), native, native_gradients, absolute
            )

    def splat_gradients(self, sums: Tensor) -> Tensor:
        """Return the gradients of the numbers of splats [I, N, SPLAT_FIELDS] from the sums of backward_sums."""
        return self.work.splat_gradients(sums)

    def fields_backward(self, sums: Tensor, request: GradientRequest) -> InputGradients:
        """Return the gradients of all inputs but the background: the second half of backward()."""
        shape = self.work.splats.splats.shape
        sums = check_tensor("sums", sums, tuple(shape), self.scene.dtype, self.scene.device)
        with device_guard(self.scene.device):
            return self.work.fields_backward(self.inputs.cameras, sums, self.inputs.completed(request))

    def _natives(self, images: ImageBuffers, gradients: ImageBuffers) -> list[_core.float32.Images]:
        """Return the core's views of both, which are valid as long as this render."""
        self._held = self._checked("", images), self._checked("g_", gradients)
        return [self.scene.core.Images(*(0 if t is None else t.data_ptr() for t in group)) for group in self._held]

    def _checked(self, prefix: str, images: ImageBuffers) -> ImageBuffers:
        """Return the images contiguous. Raises InputError."""
        like = self.scene.dtype, self.scene.device
        image, alpha, depth = (
            None if tensor is None else check_tensor(prefix + name, tensor, shape, *like)
            for name, tensor, shape in zip(images._fields, images, self.inputs.shapes)
        )
        assert image is not None
        return ImageBuffers(image, alpha, depth)


def draw_in_chunks(
    fields: Sequence[Tensor],
    background: Tensor,
    cameras: Sequence[Tensor],
    width: int,
    height: int,
    antialiased: bool,
    model: int = 0,
    *,
    alpha: bool = False,
    depth: bool = False,
    stats: Stats | None = None,
    threads: int | None = None,
    aperture: Aperture = PINHOLE,
) -> ImageBuffers:
    """Draw one scene before V cameras without gradients, some cameras at a time, to the same bits as in one draw.

    In addition to the images it takes CHUNK_BYTES for a chunk of cameras. Each takes 192 bytes a Gaussian, and 4 a
    pixel for each of alpha and depth that is not asked for.

    Args:
        fields: means, quaternions, scales, opacities and sh as in ImageArguments, with B = 1.
        background: [1, V, 3].
        cameras: world_to_camera, intrinsics and limits as in ImageArguments, with B = 1.
        width: of all images, pixels.
        height: likewise.
        antialiased: see images.render.
        model: see ImageArguments.
        alpha: whether alpha is asked for.
        depth: whether depth, the sum of weight * z, is asked for.
        stats: filled with times and counts.
        threads: of the CPU; None: torch's.
        aperture: of all cameras.

    Returns:
        image [1, V, H, W, 3], alpha and depth [1, V, H, W] or None.

    Raises:
        InputError: for other shapes, types, devices or sizes.
    """
    options = width, height, antialiased, model
    whole = ImageInputs(fields, cameras, *options, aperture=aperture)
    scene, count = whole.scene, whole.images
    image = scene.new(1, count, height, width, 3)
    found = [scene.new(1, count, height, width) if asked else None for asked in (alpha, depth)]
    unasked = sum(t is None for t in found) * width * height
    camera_bytes = image.element_size() * (_SPLAT_NUMBERS * scene.count + unasked)
    step = max(1, CHUNK_BYTES // max(camera_bytes, 1))
    for first in range(0, count, step):
        chunk = slice(first, first + step)
        chunk_stats = Stats(device=None if stats is None else stats.device)
        inputs = whole
        if step < count:
            inputs = ImageInputs(fields, [t[:, chunk] for t in cameras], *options, aperture=aperture)
        render = ImageRender(inputs, background[:, chunk], stats=chunk_stats, threads=threads)
        drawn = render.draw(ImageBuffers(image[:, chunk], *(None if t is None else t[:, chunk] for t in found)))
        if stats is not None:
            chunk_stats.add_buffers(*(t for t, mine in zip(drawn[1:], found) if mine is None and t is not None))
            stats.add_render(chunk_stats)
        del inputs, render, drawn  # or they would be held beside the next chunk
    return ImageBuffers(image, *found)


def divide_by_alpha(depth: Tensor, alpha: Tensor) -> Tensor:
    """Turn the sum of weight * z [B, V, H, W] into the expected depth in place, an image at a time to save memory."""
    for image_depth, image_alpha in zip(depth.flatten(0, 1), alpha.flatten(0, 1)):
        torch.div(image_depth, image_alpha.clamp_min(1e-10), out=image_depth)
    return depth
