"""Ordinary images on CUDA as two nodes of autograd.

Autograd lets go of what a node keeps once that is done: so images, splats and lists are gone when the gradients of the
Gaussians come to be. What the host does here keeps the device waiting where there are few Gaussians, so arguments are
checked once for both nodes, and scenes without a batch are taken as they are: a view of each would be a node as well.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs.rasterizer.dense_job import DenseArguments, DenseImages, DenseJob
from lightfield_gs.rasterizer.first_derivatives import differentiable_once
from lightfield_gs.rasterizer.scene import State
from lightfield_gs.rasterizer.workspace import Wanted


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
