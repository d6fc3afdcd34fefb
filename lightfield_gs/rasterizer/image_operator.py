"""Ordinary images as a torch operator with its backward: torch.ops.lightfield_gs.render_dense."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.nn import Parameter

from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.autograd import differentiable_once
from lightfield_gs.rasterizer.image_render import PINHOLE, Aperture, DenseArguments, DenseImages, DenseJob
from lightfield_gs.rasterizer.scene import State, Wanted
from lightfield_gs.rasterizer.stats import Stats

_Images = tuple[Tensor, Tensor, Tensor]  # image, alpha and depth


def dense_forward(
    *arguments: Any, stats: Stats | None = None, threads: int | None = None, aperture: Aperture = PINHOLE
) -> _Images:
    """render_dense without autograd; see there. Also fills `stats`. aperture: of all cameras."""
    return cast(_Images, tuple(DenseJob.of(*arguments, stats=stats, threads=threads, aperture=aperture).draw()))


def dense_forward_with_splats(*arguments: Any) -> tuple[Tensor, ...]:
    """dense_forward, and behind its images the splats that they consist of, [B * V, N, SPLAT_FIELDS]."""
    job = DenseJob.of(*arguments)
    return (*cast(_Images, job.draw()), job.splats)


def dense_with_splats(*arguments: Any) -> tuple[Tensor, ...]:
    """render_dense, and behind its images the splats that they consist of, [B * V, N, SPLAT_FIELDS], which have no
    gradients."""
    arguments = tuple(a.contiguous() if isinstance(a, Tensor) else a for a in arguments)
    return torch.ops.lightfield_gs.render_dense_with_state(*arguments)[:4]


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
    screen: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """B scenes of N Gaussians, each seen by V cameras.

    means [B,N,3], quaternions [B,N,4] wxyz, scales [B,N,3] > 0, opacities [B,N] in (0,1], sh [B,N,K,3],
    background [B,V,3], world_to_camera [B,V,4,4], intrinsics [B,V,4] (fx, fy, cx, cy in pixels), limits [B,V,5] (see
    Cameras.limits); all float32 or all float64 (CUDA: float32). antialiased: see images.render. Returns image
    [B,V,H,W,3] over the background, alpha [B,V,H,W], depth [B,V,H,W] (sum of weight * z, not normalized).
    Differentiable in all but intrinsics and limits. screen [B,V,N,2]: read by no stage, but its gradient is that of the
    projected means, in 1 / pixels; [B,V,N,4]: then with the sums over pixels of the absolute values behind (Ye et al.,
    "AbsGS", 2024). Source: Kerbl et al. 2023. Raises InputError.
    """
    if screen is not None:
        size = [means.shape[0], *world_to_camera.shape[1:2], means.shape[1]]
        if screen.dim() != 4 or list(screen.shape[:3]) != size or screen.shape[3] not in (2, 4):
            raise InputError(f"screen must be {size} of 2 or 4 numbers, got {list(screen.shape)}")
    given = (means, quaternions, scales, opacities, sh, background, world_to_camera, intrinsics, limits)
    # Tensors that are parts of others are copied here, once: the reverse would copy them again while the device waits
    tensors = tuple(t.contiguous() for t in given)
    if _is_for_cuda(means) and _is_plain(tensors):
        return in_two_nodes(tensors[:5], tensors[5], tensors[6:], width, height, antialiased, screen)
    return _RenderDense.apply(*tensors, width, height, antialiased, screen)[:3]


def render_scene(
    fields: tuple[Tensor, ...], background: Tensor, views: tuple[Tensor, ...], options: tuple[Any, ...]
) -> _Images:
    """render_dense of one scene, whose five fields [N, ...] have no B: on CUDA without the nodes of autograd and the
    call of an operator that giving them one would take. views: world_to_camera, intrinsics and limits; options: the
    arguments that follow them, from width to screen."""
    if _is_for_cuda(fields[0]) and _is_plain((*fields, background, *views)):
        fields, views = (tuple(t.contiguous() for t in tensors) for tensors in (fields, views))
        return in_two_nodes(fields, background.contiguous(), views, *options)
    batch = (field.unsqueeze(0) for field in fields)
    return torch.ops.lightfield_gs.render_dense(*batch, background, *views, *options)


_library = torch.library.Library("lightfield_gs", "FRAGMENT")
_library.define("render_dense" + torch.library.infer_schema(render_dense, mutates_args=()))
_library.impl("render_dense", render_dense, "CompositeImplicitAutograd")


def _with_state(
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
    screen: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """render_dense, and the State that spares the reverse to project, order and bin once more."""
    job = DenseJob.of(
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
    )
    image, alpha, depth = cast(_Images, job.draw())
    return image, alpha, depth, *job.work.state()


render_dense_with_state = torch.library.custom_op(
    "lightfield_gs::render_dense_with_state", _with_state, mutates_args=(), device_types=("cpu", "cuda")
)


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
    screen=None,
):
    lead, count = world_to_camera.shape[:2], means.shape[1]
    size = (*lead, height, width)
    state = [means.new_empty(shape) for shape in State.shapes(lead[0] * lead[1], count, 0)]
    lists = means.new_empty(torch.library.get_ctx().new_dynamic_size(), dtype=torch.uint8)
    return means.new_empty((*size, 3)), means.new_empty(size), means.new_empty(size), *state, lists


def _of_state(
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
    g_alpha: Tensor | None,
    g_depth: Tensor | None,
    antialiased: bool = False,
    screen_numbers: int = 0,
    cameras: bool = True,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of render_dense's first seven arguments and, of `screen_numbers` 2 or 4, of its screen, from what
    render_dense_with_state returned and the gradients of its images. cameras: whether that of world_to_camera is asked
    for; zeros where it is not."""
    job = DenseJob.of(
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
        state=State(splats, colours, lists),
    )
    found = job.backward(
        DenseImages(image, alpha, depth), DenseImages(g_image, g_alpha, g_depth), Wanted(screen_numbers, cameras)
    )
    g_background = found.background_parts.view(*job.arguments.lead, -1, 3).sum(2)
    g_screen = found.screen.view(*job.arguments.lead, means.shape[1], screen_numbers)
    g_means, g_quaternions, g_scales, g_opacities, g_sh = found.fields
    g_cameras = found.cameras.view(*job.arguments.lead, 4, 4) if cameras else torch.zeros_like(world_to_camera)
    return g_means, g_quaternions, g_scales, g_opacities, g_sh, g_background, g_cameras, g_screen


render_dense_backward = torch.library.custom_op(
    "lightfield_gs::render_dense_backward", _of_state, mutates_args=(), device_types=("cpu", "cuda")
)


@render_dense_backward.register_fake
def _(
    means,
    quaternions,
    scales,
    opacities,
    sh,
    background,
    world_to_camera,
    *rest,
    antialiased=False,
    screen_numbers=0,
    cameras=True,
):
    inputs = (means, quaternions, scales, opacities, sh, background, world_to_camera)
    screen = means.new_empty(*world_to_camera.shape[:2], means.shape[1], screen_numbers)
    return (*(torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs), screen)


def _is_plain(inputs: tuple) -> bool:
    """Whether these are tensors with memory of their own, so that operators need not be called as such: recording them
    for a trace or a compiler takes the host 0.1 ms each time, while the device waits."""
    plain = all(type(t) in (Tensor, Parameter) for t in inputs if isinstance(t, Tensor))
    return plain and not torch.compiler.is_compiling()


def _dense_setup(ctx, inputs, output):
    *tensors, ctx.width, ctx.height, ctx.antialiased, screen = inputs
    ctx.screen_numbers = 0 if screen is None else screen.shape[-1]
    ctx.save_for_backward(*tensors, *output)
    ctx.mark_non_differentiable(*output[3:])
    ctx.set_materialize_grads(False)  # the state has no gradients, and neither have images that the loss does not read


@differentiable_once
def _dense_backward(ctx, *grads):
    saved = ctx.saved_tensors
    g_image = torch.zeros_like(saved[9]) if grads[0] is None else grads[0]
    reverse = _of_state if _is_plain(saved) else torch.ops.lightfield_gs.render_dense_backward
    *out, g_screen = reverse(
        *saved[:9],
        ctx.width,
        ctx.height,
        *saved[9:],
        g_image,
        *grads[1:3],
        antialiased=ctx.antialiased,
        screen_numbers=ctx.screen_numbers,
        cameras=ctx.needs_input_grad[6],
    )
    return (*out, None, None, None, None, None, g_screen if ctx.screen_numbers else None)


render_dense_with_state.register_autograd(_dense_backward, setup_context=_dense_setup)


class _RenderDense(torch.autograd.Function):
    """render_dense_with_state with the same reverse as by register_autograd, but recorded faster.

    register_autograd compares every argument with its default. That takes the host 0.1 ms between forward and reverse,
    while the device waits.
    """

    @staticmethod
    def forward(ctx, *inputs):
        forward = _with_state if _is_plain(inputs) else torch.ops.lightfield_gs.render_dense_with_state
        outputs = forward(*inputs)
        _dense_setup(ctx, inputs, outputs)
        return outputs

    backward = staticmethod(_dense_backward)


def _is_for_cuda(means: Tensor) -> bool:
    """Whether the stages are those of CUDA, whose reverse has two halves."""
    return means.is_cuda


def in_two_nodes(
    fields: tuple[Tensor, ...],
    background: Tensor,
    views: tuple[Tensor, ...],
    width: int,
    height: int,
    antialiased: bool,
    screen: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """render_dense by way of splats. fields: its first five arguments, contiguous, or those of one scene without B;
    views: world_to_camera, intrinsics and limits."""
    made: list[DenseJob] = []
    options = (width, height, antialiased)
    state = _Project.apply(*fields, *views, background.detach(), options, screen, made)
    absolute = screen is not None and screen.shape[-1] == 4
    return _Composite.apply(*state, background, made.pop(), absolute)


class _Project(torch.autograd.Function):
    """Gaussians to the State of a render. As the gradient of its splats it takes the sums that DenseJob.sums finds."""

    @staticmethod
    def forward(ctx, *inputs):
        """made: a list to which the job is added, ready for the composite."""
        *tensors, background, options, screen, made = inputs
        ctx.batched = tensors[0].dim() == 3
        job = DenseJob(_arguments(tensors, options), background)
        made.append(job)
        ctx.save_for_backward(*tensors)
        ctx.options, ctx.screen_numbers = options, 0 if screen is None else screen.shape[-1]
        state = job.work.state()
        ctx.mark_non_differentiable(state.colours, state.lists)
        ctx.set_materialize_grads(False)
        return tuple(state)

    @staticmethod
    @differentiable_once
    def backward(ctx, sums, *_):
        if sums is None:
            return (None,) * 12
        arguments = _arguments(ctx.saved_tensors, ctx.options)
        wanted = Wanted(ctx.screen_numbers, ctx.needs_input_grad[5])
        fields, g_cameras, screen = arguments.of_sums(sums.contiguous(), wanted)
        return (
            *(fields if ctx.batched else (g.squeeze(0) for g in fields)),
            g_cameras.view(*arguments.lead, 4, 4) if wanted.cameras else None,
            *(None,) * 4,  # intrinsics, limits, background and options
            screen.view(*arguments.lead, arguments.scene.count, ctx.screen_numbers) if ctx.screen_numbers else None,
            None,
        )


class _Composite(torch.autograd.Function):
    """The State of a render to images. The gradient of splats is as _Project takes it."""

    @staticmethod
    def forward(ctx, splats, colours, lists, background, job, absolute):
        ctx.arguments, ctx.absolute = job.arguments.without_values(), absolute
        images = tuple(job.draw())
        ctx.save_for_backward(splats, colours, lists, background, *images)
        ctx.set_materialize_grads(False)
        return images

    @staticmethod
    @differentiable_once
    def backward(ctx, g_image, g_alpha, g_depth):
        splats, colours, lists, background, image, alpha, depth = ctx.saved_tensors
        job = DenseJob(ctx.arguments, background, state=State(splats, colours, lists))
        g_image = torch.zeros_like(image) if g_image is None else g_image
        sums, parts = job.sums(DenseImages(image, alpha, depth), DenseImages(g_image, g_alpha, g_depth), ctx.absolute)
        g_background = parts.view(*ctx.arguments.lead, -1, 3).sum(2) if ctx.needs_input_grad[3] else None
        return sums, None, None, g_background, None, None


def _arguments(tensors, options) -> DenseArguments:
    """Of five fields, with B or without, and world_to_camera, intrinsics and limits."""
    fields = tensors[:5] if tensors[0].dim() == 3 else [t.unsqueeze(0) for t in tensors[:5]]
    return DenseArguments(*fields, *tensors[5:], *options)
