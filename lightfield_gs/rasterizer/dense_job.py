"""Ordinary images without autograd: their stages, and the gradients that follow from gradients of the images."""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.scene import Scene, State, check
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import DenseGradients, Wanted
from lightfield_gs.rasterizer.workspace_cuda import CudaWorkspace, project_dense_backward
from lightfield_gs.rasterizer.workspaces import workspace_of


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
