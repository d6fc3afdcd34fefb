"""Ordinary images as a torch operator with its reverse: torch.ops.lightfield_gs.render_dense.

Its stages are project, order, bin and composite (docs/design.md). The result is deterministic: the same bits whatever
the number of threads. Every argument is checked here, and every buffer is a torch tensor.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.scene import Scene, State, check
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspaces import workspace_of

_Images = tuple[Tensor, Tensor, Tensor]  # image, alpha and depth
_Arguments = tuple[  # of render_dense
    Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, int, int, bool
]


class _DenseJob:
    """The checked arguments of render_dense, and a workspace that is ready for the composite or its reverse.

    Without `state` project, order and bin run here; with it the workspace consists of what a render of the same
    arguments left.
    """

    def __init__(
        self,
        means,
        quaternions,
        scales,
        opacities,
        sh,
        background,
        world_to_camera,
        intrinsics,
        limits,
        width: int,
        height: int,
        antialiased: bool,
        stats: Stats,
        threads: int,
        state: State | None = None,
    ):
        self.scene = scene = Scene(means, quaternions, scales, opacities, sh)
        if world_to_camera.dim() != 4:
            raise InputError(f"world_to_camera must be [scenes, cameras, 4, 4], got {list(world_to_camera.shape)}")
        if not (1 <= width <= 65536 and 1 <= height <= 65536):
            raise InputError(f"image size must be 1..65536 pixels each way, got {width} x {height}")
        self.lead = lead = (scene.batch, world_to_camera.shape[1])
        self.images, self.width, self.height, self.threads = lead[0] * lead[1], width, height, threads
        self.background = check("background", background, (*lead, 3), means)
        self.cameras_tensors = [
            check("world_to_camera", world_to_camera, (*lead, 4, 4), means),
            check("intrinsics", intrinsics, (*lead, 4), means),
            check("limits", limits, (*lead, 5), means),
        ]
        poses, optics, edges = (t.data_ptr() for t in self.cameras_tensors)
        self.cameras = scene.core.Cameras(*lead, width, height, poses, optics, edges, antialiased)
        with scene.guard:
            self.work = workspace_of(scene, self.images, width, height, stats, threads, state=state)
            if state is None:
                with stats.stage("project"):
                    self.work.project_dense(self.cameras)
                self.work.order_and_bin()

    def image_shapes(self) -> list[tuple[int, ...]]:
        size = (*self.lead, self.height, self.width)
        return [(*size, 3), size, size]


def dense_forward(*arguments: Any, stats: Stats | None = None, threads: int | None = None) -> _Images:
    """render_dense without autograd; see there. Also fills `stats`."""
    return _dense_forward(arguments, stats or Stats(), threads or torch.get_num_threads())[0]


def _dense_forward(arguments: _Arguments, stats: Stats, threads: int) -> tuple[_Images, State]:
    """The images, and the state that spares their reverse the stages before the composite."""
    job = _DenseJob(*arguments, stats, threads)
    with job.scene.guard, stats.stage("composite"):
        image, alpha, depth = (job.scene.new(*shape) for shape in job.image_shapes())
        native = job.scene.core.DenseImages(image.data_ptr(), alpha.data_ptr(), depth.data_ptr())
        job.work.composite_dense(job.cameras, job.background, native)
    return (image, alpha, depth), job.work.state()


def render_dense(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    limits: Tensor,
    width: int,
    height: int,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """B scenes of N Gaussians, each seen by V cameras.

    means [B,N,3], quaternions [B,N,4] wxyz, scales [B,N,3] > 0, opacities [B,N] in (0,1], sh [B,N,K,3],
    background [B,V,3], world_to_camera [B,V,4,4], intrinsics [B,V,4] (fx, fy, cx, cy in pixels), limits [B,V,5] (see
    Cameras.limits); all float32 or all float64 (CUDA: float32). antialiased: see images.render. Returns image
    [B,V,H,W,3] over the background, alpha [B,V,H,W], depth [B,V,H,W] (sum of weight * z, not normalized).
    Differentiable in all but intrinsics and limits. Source: Kerbl et al. 2023. Raises InputError.
    """
    tensors = (means, quaternions, scales, opacities, sh, background, world_to_camera, intrinsics, limits)
    # Tensors that are parts of others are copied here, once: the reverse would copy them again while the device waits
    return _RenderDense.apply(*(t.contiguous() for t in tensors), width, height, antialiased)[:3]


_library = torch.library.Library("lightfield_gs", "FRAGMENT")
_library.define("render_dense" + torch.library.infer_schema(render_dense, mutates_args=()))
_library.impl("render_dense", render_dense, "CompositeImplicitAutograd")


@torch.library.custom_op("lightfield_gs::render_dense_with_state", mutates_args=(), device_types=("cpu", "cuda"))
def render_dense_with_state(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    limits: Tensor,
    width: int,
    height: int,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """render_dense, and the State that spares the reverse to project, order and bin once more."""
    out, state = _dense_forward(
        (
            means,
            quaternions,
            scales,
            opacities,
            sh,
            background,
            world_to_camera,
            intrinsics,
            limits,
            width,
            height,
            antialiased,
        ),
        Stats(),
        torch.get_num_threads(),
    )
    return (*out, *state)


@render_dense_with_state.register_fake
def _(
    means,
    quaternions,
    scales,
    opacities,
    sh,
    background,
    world_to_camera,
    intrinsics,
    limits,
    width,
    height,
    antialiased=False,
):
    lead, count = world_to_camera.shape[:2], means.shape[1]
    size = (*lead, height, width)
    state = [means.new_empty(shape) for shape in State.shapes(lead[0] * lead[1], count, 0)]
    lists = means.new_empty(torch.library.get_ctx().new_dynamic_size(), dtype=torch.uint8)
    return means.new_empty((*size, 3)), means.new_empty(size), means.new_empty(size), *state, lists


@torch.library.custom_op("lightfield_gs::render_dense_backward", mutates_args=(), device_types=("cpu", "cuda"))
def render_dense_backward(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    world_to_camera: Tensor,
    intrinsics: Tensor,
    limits: Tensor,
    width: int,
    height: int,
    image: Tensor,
    alpha: Tensor,
    depth: Tensor,
    splats: Tensor,
    colours: Tensor,
    lists: Tensor,
    g_image: Tensor,
    g_alpha: Tensor,
    g_depth: Tensor,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of render_dense's first seven arguments from what render_dense_with_state returned and the gradients of
    its images."""
    threads = torch.get_num_threads()
    job = _DenseJob(
        means,
        quaternions,
        scales,
        opacities,
        sh,
        background,
        world_to_camera,
        intrinsics,
        limits,
        width,
        height,
        antialiased,
        Stats(),
        threads,
        State(splats, colours, lists),
    )
    core, work = job.scene.core, job.work
    images = [
        check(n, t, s, means) for n, t, s in zip(("image", "alpha", "depth"), (image, alpha, depth), job.image_shapes())
    ]
    grads = [
        check(n, t, s, means)
        for n, t, s in zip(("g_image", "g_alpha", "g_depth"), (g_image, g_alpha, g_depth), job.image_shapes())
    ]
    native = [core.DenseImages(*(t.data_ptr() for t in ts)) for ts in (images, grads)]
    with job.scene.guard:
        out, parts, g_cameras = work.dense_backward(job.cameras, job.background, *native)
    g_means, g_quaternions, g_scales, g_opacities, g_sh = out
    g_background = parts.view(*job.lead, -1, 3).sum(2)
    return g_means, g_quaternions, g_scales, g_opacities, g_sh, g_background, g_cameras.view(*job.lead, 4, 4)


@render_dense_backward.register_fake
def _(means, quaternions, scales, opacities, sh, background, world_to_camera, *rest):
    inputs = (means, quaternions, scales, opacities, sh, background, world_to_camera)
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs)


def _dense_setup(ctx, inputs, output):
    *tensors, ctx.width, ctx.height, ctx.antialiased = inputs
    ctx.save_for_backward(*tensors, *output)
    ctx.mark_non_differentiable(*output[3:])
    ctx.set_materialize_grads(False)  # the state has no gradients, and needs no zeros for them


def _dense_backward(ctx, *grads):
    saved = ctx.saved_tensors
    grads = [torch.zeros_like(out) if g is None else g for g, out in zip(grads[:3], saved[9:])]
    out = torch.ops.lightfield_gs.render_dense_backward(
        *saved[:9], ctx.width, ctx.height, *saved[9:], *grads, ctx.antialiased
    )
    return (*out, None, None, None, None, None)


render_dense_with_state.register_autograd(_dense_backward, setup_context=_dense_setup)


class _RenderDense(torch.autograd.Function):
    """render_dense_with_state with the same reverse as by register_autograd, but recorded faster.

    register_autograd compares every argument with its default. That takes the host 0.1 ms between forward and reverse,
    while the device waits.
    """

    @staticmethod
    def forward(ctx, *inputs):
        outputs = torch.ops.lightfield_gs.render_dense_with_state(*inputs)
        _dense_setup(ctx, inputs, outputs)
        return outputs

    backward = staticmethod(_dense_backward)
