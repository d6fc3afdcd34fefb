"""Ordinary images without autograd: their stages, their gradients, and many images in parts."""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.scene import DenseGradients, Scene, State, Wanted, check
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import workspace_of
from lightfield_gs.rasterizer.workspace_cuda import CudaWorkspace, project_dense_backward


class DenseImages(NamedTuple):
    """Image [B,V,H,W,3], alpha and depth [B,V,H,W]; or gradients of them, where None stands for zeros."""

    image: Tensor
    alpha: Tensor | None
    depth: Tensor | None


class Aperture(NamedTuple):
    """What cameras of a rig average their pictures over: offsets of this standard deviation along the camera's x-axis,
    what lies at zero_depth staying where it is; scene units."""

    deviation: float
    zero_depth: float


PINHOLE = Aperture(0.0, math.inf)


class DenseArguments:
    """The checked arguments of render_dense, but for the background. Raises InputError."""

    def __init__(
        self,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor,
        world_to_camera: Tensor,
        intrinsics: Tensor,
        limits: Tensor,
        width: int,
        height: int,
        antialiased: bool = False,
        *,
        aperture: Aperture = PINHOLE,
    ):
        self.scene = scene = Scene(means, quaternions, scales, opacities, sh)
        if world_to_camera.dim() != 4:
            raise InputError(f"world_to_camera must be [scenes, cameras, 4, 4], got {list(world_to_camera.shape)}")
        if not (1 <= width <= 65536 and 1 <= height <= 65536):
            raise InputError(f"image size must be 1..65536 pixels each way, got {width} x {height}")
        self.lead = lead = (scene.batch, world_to_camera.shape[1])
        self.images, self.width, self.height = lead[0] * lead[1], width, height
        self.cameras_tensors = [
            check("world_to_camera", world_to_camera, (*lead, 4, 4), means),
            check("intrinsics", intrinsics, (*lead, 4), means),
            check("limits", limits, (*lead, 5), means),
        ]
        poses, optics, edges = (t.data_ptr() for t in self.cameras_tensors)
        self.cameras = scene.core.Cameras(*lead, width, height, poses, optics, edges, antialiased, *aperture)

    def without_values(self) -> DenseArguments:
        """The same, but it keeps no tensors alive: see Scene.without_values."""
        other = copy.copy(self)
        other.scene, other.cameras_tensors = self.scene.without_values(), []
        return other

    def of_sums(self, sums: Tensor, wanted: Wanted) -> tuple[list[Tensor], Tensor, Tensor]:
        """On CUDA, what follows from the sums that DenseJob.sums found: gradients of the fields, of the cameras and of
        the splats' places, as DenseGradients has them."""
        with self.scene.guard:
            return project_dense_backward(self.scene, self.cameras, sums, wanted)


class DenseJob:
    """Arguments of render_dense, and a workspace that is ready for the composite or its reverse.

    Without `state` project, order and bin run here; with it the workspace consists of what a render of the same
    arguments left. room: on CUDA, how many (tile, splat) pairs there is room for: then nothing waits for the device,
    and `pairs_on_device` has to be looked at. Raises InputError.
    """

    def __init__(
        self,
        arguments: DenseArguments,
        background: Tensor,
        *,
        stats: Stats | None = None,
        threads: int | None = None,
        state: State | None = None,
        room: int | None = None,
    ):
        self.arguments, self.scene, self.stats = arguments, arguments.scene, stats or Stats()
        self.background = check("background", background, (*arguments.lead, 3), self.scene)
        with self.scene.guard:
            self.work = workspace_of(
                self.scene,
                arguments.images,
                arguments.width,
                arguments.height,
                self.stats,
                threads or torch.get_num_threads(),
                state=state,
                room=room,
            )
            if state is None:
                with self.stats.stage("project"):
                    self.work.project_dense(arguments.cameras)
                self.work.order_and_bin()

    @classmethod
    def of(
        cls,
        means: Tensor,
        quaternions: Tensor,
        scales: Tensor,
        opacities: Tensor,
        sh: Tensor,
        background: Tensor,
        *views: Any,
        aperture: Aperture = PINHOLE,
        **options: Any,
    ) -> DenseJob:
        """The job of the arguments of render_dense: views are those that follow the background. aperture: of all
        cameras. options: of DenseJob."""
        arguments = DenseArguments(means, quaternions, scales, opacities, sh, *views, aperture=aperture)
        return cls(arguments, background, **options)

    @property
    def pairs_on_device(self) -> Tensor:
        """[1] int64: how many pairs there are, of a job with `room`. If it is larger, the images are not right."""
        return self.work.pairs_on_device

    @property
    def splats(self) -> Tensor:
        """What the Gaussians are in each image, [B * V, N, SPLAT_FIELDS]."""
        return self.work.splats.splats

    def draw(self, out: DenseImages | None = None) -> DenseImages:
        """The images; out: those of them that there is memory for, contiguous, where None stands for new ones."""
        scene, given = self.scene, out or (None, None, None)
        with scene.guard, self.stats.stage("composite"):
            image, alpha, depth = (scene.new(*s) if t is None else t for t, s in zip(given, self._shapes()))
            native = scene.core.Images(image.data_ptr(), alpha.data_ptr(), depth.data_ptr())
            self.work.composite_dense(self.arguments.cameras, self.background, native)
        return DenseImages(image, alpha, depth)

    def backward(self, images: DenseImages, gradients: DenseImages, wanted: Wanted) -> DenseGradients:
        """What follows from the gradients of the images that draw() returned."""
        of_images, of_gradients = self._natives(images, gradients)
        with self.scene.guard:
            return self.work.dense_backward(self.arguments.cameras, self.background, of_images, of_gradients, wanted)

    def sums(self, images: DenseImages, gradients: DenseImages, absolute: bool) -> tuple[Tensor, Tensor]:
        """On CUDA, the first half of backward(): sums over each splat's pairs [I, N, SPLAT_SUMS], from which a
        DenseArguments goes on, and the gradient of the background in parts [I * parts, 3]."""
        of_images, of_gradients = self._natives(images, gradients)
        with self.scene.guard:
            return cast(CudaWorkspace, self.work).composite_dense_backward(
                self.background, of_images, of_gradients, absolute
            )

    def _natives(self, images: DenseImages, gradients: DenseImages) -> list[_core.float32.Images]:
        """The core's views of both, which hold as long as the job."""
        self._held = self._checked("", images), self._checked("g_", gradients)
        return [self.scene.core.Images(*(0 if t is None else t.data_ptr() for t in group)) for group in self._held]

    def _checked(self, prefix: str, images: DenseImages) -> DenseImages:
        """The same, contiguous."""
        image, alpha, depth = (
            None if tensor is None else check(prefix + name, tensor, shape, self.scene)
            for name, tensor, shape in zip(images._fields, images, self._shapes())
        )
        assert image is not None
        return DenseImages(image, alpha, depth)

    def _shapes(self) -> list[tuple[int, ...]]:
        size = (*self.arguments.lead, self.arguments.height, self.arguments.width)
        return [(*size, 3), size, size]


# Of what is held beside the images: views go in parts that take about so much, or one at a time if one takes more
PART_BYTES = 1 << 29
# Numbers for a splat in one view: itself, its colour, its place in the order, and its pairs where it has a few
_SPLAT_NUMBERS = 48


def dense_in_parts(
    fields: list[Tensor],
    background: Tensor,
    views: list[Tensor],
    width: int,
    height: int,
    antialiased: bool,
    *,
    alpha: bool = False,
    depth: bool = False,
    stats: Stats | None = None,
    threads: int | None = None,
    aperture: Aperture = PINHOLE,
) -> DenseImages:
    """What render_dense draws of one scene: image [1, V, H, W, 3], and alpha and depth [1, V, H, W] if asked for.

    fields, background and views as render_dense takes them, with B = 1. Of V images of H x W pixels and N Gaussians it
    takes 12 + 4 (alpha) + 4 (depth) bytes a pixel (of float32) for the images, and beside them those of as many views
    as fit PART_BYTES, each 192 N bytes, and 4 a pixel for each of alpha and depth that is not asked for. Every bit is
    that of render_dense. Raises InputError.
    """
    arguments: list[Any] = [*fields, *views, width, height, antialiased]
    whole = DenseArguments(*arguments, aperture=aperture)
    scene, count = whole.scene, whole.images
    image = scene.new(1, count, height, width, 3)
    found = [scene.new(1, count, height, width) if wanted else None for wanted in (alpha, depth)]
    unasked = sum(t is None for t in found) * width * height
    of_one = image.element_size() * (_SPLAT_NUMBERS * scene.count + unasked)
    step = max(1, PART_BYTES // max(of_one, 1))
    for first in range(0, count, step):
        part = slice(first, first + step)
        one = Stats(device=None if stats is None else stats.device)
        job = DenseJob.of(
            *fields,
            background[:, part],
            *(t[:, part] for t in views),
            width,
            height,
            antialiased,
            stats=one,
            threads=threads,
            aperture=aperture,
        )
        drawn = job.draw(DenseImages(image[:, part], *(None if t is None else t[:, part] for t in found)))
        if stats is not None:
            one.add_buffers(*(t for t, mine in zip(drawn[1:], found) if mine is None and t is not None))
            stats.add_render(one)
        del job, drawn  # or the next part would be held beside this one
    return DenseImages(image, *found)


def divide_by_alpha(depth: Tensor, alpha: Tensor) -> Tensor:
    """The expected depth [1, V, H, W] from the sum of weight * z, in its place: a view at a time, whose temporary is
    all that it takes."""
    for of_view, coverage in zip(depth[0], alpha[0]):
        torch.div(of_view, coverage.clamp_min(1e-10), out=of_view)
    return depth
