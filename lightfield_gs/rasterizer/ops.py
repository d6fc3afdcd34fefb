"""The rasterizer as torch operators: torch.ops.lightfield_gs.render_dense and render_lens, with their reverses.

Both run project -> order -> bin -> composite. The *dense* sensor is an ordinary image; the *lens* sensor gives every
sub-pixel of a panel the camera offset of its own view. Both are deterministic: the same bits whatever the number of
threads. Every argument is checked here, every buffer is a torch tensor.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from lightfield_gs import _core
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.lens import native_lens
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.workspace import Scene, State, Stats, Workspace, check

COLOUR_ORDERS = (8, 16)  # polynomial orders tried for colours that vary over a rig
# The same for frames on CUDA, which remember the order that was good enough
FRAME_COLOUR_ORDERS = (2, 4, 8, 12, 16)


def _workspace(
    scene: Scene,
    images: int,
    width: int,
    height: int,
    colour_order: int,
    stats: Stats,
    threads: int,
    lens: bool,
    state: State | None = None,
    compensated: bool = False,
) -> Any:
    """The workspace of the scene's device."""
    if scene.tensors[0].is_cuda:
        from lightfield_gs.rasterizer.workspace_cuda import CudaWorkspace

        return CudaWorkspace(scene, images, width, height, colour_order, stats, lens, state, compensated=compensated)
    return Workspace(scene, images, width, height, colour_order, stats, threads, state, compensated)


# Dense: ordinary images


class _DenseJob:
    """Arguments of render_dense, checked, and the stages up to the composite, or what a render left of them."""

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
        self.cameras = scene.core.Cameras(
            *lead, width, height, *(t.data_ptr() for t in self.cameras_tensors), antialiased
        )
        with scene.guard:
            self.work = _workspace(scene, self.images, width, height, 0, stats, threads, lens=False, state=state)
            if state is None:
                with stats.stage("project"):
                    self.work.project_dense(self.cameras)
                self.work.order_and_bin()

    def image_shapes(self) -> list[tuple[int, ...]]:
        size = (*self.lead, self.height, self.width)
        return [(*size, 3), size, size]


def dense_forward(*arguments: Any, stats: Stats | None = None, threads: int | None = None) -> tuple[Tensor, ...]:
    """render_dense without autograd; see there. Also fills `stats`."""
    return _dense_forward(arguments, stats or Stats(), threads or torch.get_num_threads())[0]


def _dense_forward(arguments: tuple[Any, ...], stats: Stats, threads: int) -> tuple[tuple[Tensor, ...], State]:
    job = _DenseJob(*arguments, stats, threads)
    with job.scene.guard, stats.stage("composite"):
        out = [job.scene.new(*shape) for shape in job.image_shapes()]
        native = job.scene.core.DenseImages(*(t.data_ptr() for t in out))
        job.work.composite_dense(job.cameras, job.background, native)
    return tuple(out), job.work.state()


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
    Cameras.limits); all float32 or all float64 (CUDA: float32). antialiased: see rendering.render. Returns image
    [B,V,H,W,3] over the background, alpha [B,V,H,W], depth [B,V,H,W] (sum of weight * z, not normalized).
    Differentiable in all but intrinsics and limits. Source: Kerbl et al. 2023. Raises InputError.
    """
    tensors = (means, quaternions, scales, opacities, sh, background, world_to_camera, intrinsics, limits)
    # Views are copied here, once: the reverse would copy them again, while the device waits for it
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
    return (*out, parts.view(*job.lead, -1, 3).sum(2), g_cameras.view(*job.lead, 4, 4))


@render_dense_backward.register_fake
def _(means, quaternions, scales, opacities, sh, background, world_to_camera, *rest):
    inputs = (means, quaternions, scales, opacities, sh, background, world_to_camera)
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs)


def _dense_setup(ctx, inputs, output):
    *tensors, ctx.width, ctx.height, ctx.antialiased = inputs
    ctx.save_for_backward(*tensors, *output)
    ctx.mark_non_differentiable(*output[3:])
    ctx.set_materialize_grads(False)  # no zeros for the state


def _dense_backward(ctx, *grads):
    saved = ctx.saved_tensors
    grads = [torch.zeros_like(out) if g is None else g for g, out in zip(grads[:3], saved[9:])]
    out = torch.ops.lightfield_gs.render_dense_backward(
        *saved[:9], ctx.width, ctx.height, *saved[9:], *grads, ctx.antialiased
    )
    return (*out, None, None, None, None, None)


render_dense_with_state.register_autograd(_dense_backward, setup_context=_dense_setup)


class _RenderDense(torch.autograd.Function):
    """render_dense_with_state as register_autograd records it, without its look at every argument's default: the host
    takes 0.1 ms for that, between forward and reverse, where the device waits for it."""

    @staticmethod
    def forward(ctx, *inputs):
        outputs = torch.ops.lightfield_gs.render_dense_with_state(*inputs)
        _dense_setup(ctx, inputs, outputs)
        return outputs

    backward = staticmethod(_dense_backward)


# Lens: the sub-pixels of a panel


class LensArguments:
    """Arguments of render_lens, checked."""

    def __init__(
        self,
        means,
        quaternions,
        scales,
        opacities,
        sh,
        background,
        rig: list[float],
        lens: list[int],
        lens_shape: list[float],
        antialiased: bool = False,
    ):
        self.scene = scene = Scene(*(t.unsqueeze(0) for t in (means, quaternions, scales, opacities, sh)))
        self.background = check("background", background, (3,), means)
        self.lens = native_lens(lens, lens_shape)
        self.width, self.height = lens[0], lens[1]
        if len(rig) != 26:
            raise InputError(f"rig must be 26 numbers (see render_lens), got {len(rig)}")
        self.rig = _core.Rig(
            world_to_camera=rig[:16],
            intrinsics=rig[16:20],
            limits=rig[20:25],
            zero_depth=rig[25],
            lens=self.lens,
            antialiased=antialiased,
        )
        self.antialiased = antialiased
        self.numbers = (*rig, *lens, *lens_shape, antialiased)
        # Colours: raise the order until the polynomials are good enough. float64 is the exact twin: highest order.
        exact = means.dtype == torch.float64
        self.colour_orders = (0,) if scene.degree == 0 else COLOUR_ORDERS[-1:] if exact else COLOUR_ORDERS

    def image(self, as_bytes: bool = False) -> Tensor:
        return self.scene.new(self.height, self.width, 3, dtype=torch.uint8 if as_bytes else None)


def projected_lens(job: LensArguments, stats: Stats, threads: int, quality: Quality) -> Any:
    """The workspace of a light field after its projection."""
    with job.scene.guard, stats.stage("project"):
        for order in job.colour_orders:
            work = _workspace(
                job.scene, 1, job.width, job.height, order, stats, threads, lens=True, compensated=job.antialiased
            )
            stats.colour_error = work.project_lens(job.rig, job.lens, quality)
            if stats.colour_error <= quality.colour_error:
                break
    return work


def _lens_workspace(job: LensArguments, stats: Stats, threads: int, quality: Quality = EXACT) -> Any:
    """The workspace of a light field after all stages up to the composite."""
    with job.scene.guard:
        work = projected_lens(job, stats, threads, quality)
        work.order_and_bin()
    return work


def lens_forward(
    *arguments: Any,
    as_bytes: bool = False,
    quality: Quality = EXACT,
    stats: Stats | None = None,
    threads: int | None = None,
    out: Tensor | None = None,
) -> Tensor:
    """render_lens without autograd; see there. as_bytes: uint8 = round(255 clamp(c, 0, 1)). Fills `stats`, and `out`
    where it is given: an image of that size and type, checked.

    On CUDA the image is that of the fast kernels, within 1/255 but where a sample sits on a threshold.
    """
    stats, threads = stats or Stats(), threads or torch.get_num_threads()
    with stats.stage("plan"):
        job = LensArguments(*arguments)
    if job.scene.tensors[0].is_cuda:
        return draw_frame(job, frame_kind(job, quality), as_bytes, stats, out)
    return draw_lens(job, as_bytes, quality, stats, threads, out)


def draw_lens(
    job: LensArguments, as_bytes: bool, quality: Quality, stats: Stats, threads: int, out: Tensor | None = None
) -> Tensor:
    """The image of a light field on the CPU."""
    work = _lens_workspace(job, stats, threads, quality)
    with stats.stage("composite"):
        out = job.image(as_bytes) if out is None else out
        work.composite_lens(job.lens, quality, job.background, out)
    return out


def frame_kind(job: LensArguments, quality: Quality, moving: bool = False) -> Any:
    """What frames of such arguments are known to need, on CUDA. moving: of one's own, for frames of changing rigs.

    Anti-aliased ones know neither lattices nor half precision, whatever the quality."""
    from lightfield_gs.rasterizer.frame_cuda import kind_of, moving_kind

    if job.antialiased:
        quality = replace(quality, lattice_error=0.0, evaluation_error=0.0)
    orders = (0,) if job.scene.degree == 0 else FRAME_COLOUR_ORDERS
    find = moving_kind if moving else kind_of
    return find(job.scene, job.numbers, job.rig, job.lens, orders, quality)


def draw_frame(job: LensArguments, kind: Any, as_bytes: bool, stats: Stats, out: Tensor | None = None) -> Tensor:
    """The image of a frame of this kind, on CUDA."""
    with job.scene.guard:
        with stats.stage("plan"):
            frame, out = kind.frame(job.scene), job.image(as_bytes) if out is None else out
        frame.draw(job.background, out, stats)
        if not torch.cuda.is_current_stream_capturing():  # the user's graph may outlive the kind, whose memory that is
            kind.note(frame)
        if stats.device is not None:
            stats.count_frame(frame.state(), frame.work)
    return out


@torch.library.custom_op("lightfield_gs::render_lens", mutates_args=(), device_types=("cpu", "cuda"))
def render_lens(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    rig: list[float],
    lens: list[int],
    lens_shape: list[float],
    antialiased: bool = False,
) -> Tensor:
    """The image [H, W, 3] that a slanted-lenticular panel shows of N Gaussians.

    means [N,3], quaternions [N,4] wxyz, scales [N,3] > 0, opacities [N] in (0,1], sh [N,K,3], background [3]; all
    float32 or all float64 (CUDA: float32); differentiable in all of these. Every sub-pixel belongs to
    the camera at offset s = offset_start + offset_step * x of its own view coordinate x.
    rig: 26 numbers: world_to_camera (16, row-major), fx, fy, cx, cy, Jacobian limits (5, see Cameras.limits),
    zero_depth.
    lens: width, height, views, phase0, phase_x, phase_y (64-bit patterns as signed integers, 2^64 = one lens),
    bgr, continuous; of a panel with sub-pixel cells then 48 phases that its sub-pixels have beyond those of stripes, by
    row mod 4, column mod 4 and place, and 48 image channels, likewise. lens_shape: line_number, slant_tan, phase
    (sub-pixels), offset_start, offset_step (scene units). antialiased: see rendering.encode.
    lightfield_gs.encode builds them from a Panel and a Rig. Raises InputError.
    """
    job = LensArguments(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape, antialiased)
    work, out = _lens_workspace(job, Stats(), torch.get_num_threads()), job.image()
    with job.scene.guard:
        work.composite_lens(job.lens, EXACT, job.background, out)
    return out


@render_lens.register_fake
def _(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape, antialiased=False):
    return means.new_empty((lens[1], lens[0], 3))


@torch.library.custom_op("lightfield_gs::render_lens_backward", mutates_args=(), device_types=("cpu", "cuda"))
def render_lens_backward(
    means: Tensor,
    quaternions: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh: Tensor,
    background: Tensor,
    rig: list[float],
    lens: list[int],
    lens_shape: list[float],
    image: Tensor,
    g_image: Tensor,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of render_lens's first six arguments from its output and the gradient of that."""
    job = LensArguments(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape, antialiased)
    image, g_image = (
        check(n, t, (job.height, job.width, 3), means) for n, t in (("image", image), ("g_image", g_image))
    )
    work = _lens_workspace(job, Stats(), torch.get_num_threads())
    with job.scene.guard:
        out, parts = work.lens_backward(job.rig, job.lens, job.background, image, g_image)
    return (*(g.squeeze(0) for g in out), parts.sum(0))


@render_lens_backward.register_fake
def _(means, quaternions, scales, opacities, sh, background, *rest):
    inputs = (means, quaternions, scales, opacities, sh, background)
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs)


def _lens_setup(ctx, inputs, output):
    *tensors, ctx.rig, ctx.lens, ctx.lens_shape, ctx.antialiased = inputs
    ctx.save_for_backward(*tensors, output)


def _lens_backward(ctx, grad):
    *tensors, image = ctx.saved_tensors
    out = torch.ops.lightfield_gs.render_lens_backward(
        *tensors, ctx.rig, ctx.lens, ctx.lens_shape, image, grad, ctx.antialiased
    )
    return (*out, None, None, None, None)


render_lens.register_autograd(_lens_backward, setup_context=_lens_setup)
