"""Ordinary images on CUDA as two nodes of autograd.

Autograd lets go of what a node keeps once that is done: so images, splats and lists are gone when the gradients of the
Gaussians come to be.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs.rasterizer.dense_job import DenseArguments, DenseImages, DenseJob
from lightfield_gs.rasterizer.scene import State
from lightfield_gs.rasterizer.workspace import Wanted


def in_two_nodes(
    tensors: tuple[Tensor, ...], width: int, height: int, antialiased: bool, screen: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """render_dense by way of splats; tensors: its first nine arguments."""
    options = (width, height, antialiased)
    splats, colours, lists = _Project.apply(*tensors, *options, screen)
    *fields, background, world_to_camera, intrinsics, limits = tensors
    others = tuple(t.detach() for t in (*fields, world_to_camera, intrinsics, limits))
    absolute = screen is not None and screen.shape[-1] == 4
    return _Composite.apply(splats, colours, lists, background, others, *options, absolute)


class _Project(torch.autograd.Function):
    """Gaussians to the State of a render. As the gradient of its splats it takes the sums that DenseJob.sums finds."""

    @staticmethod
    def forward(ctx, *inputs):
        *tensors, width, height, antialiased, screen = inputs
        state = DenseJob(*tensors, width, height, antialiased).work.state()
        ctx.save_for_backward(*tensors[:5], *tensors[6:])
        ctx.options, ctx.screen_numbers = (width, height, antialiased), 0 if screen is None else screen.shape[-1]
        ctx.mark_non_differentiable(state.colours, state.lists)
        ctx.set_materialize_grads(False)
        return tuple(state)

    @staticmethod
    def backward(ctx, sums, *_):
        if sums is None:
            return (None,) * 13
        arguments = DenseArguments(*ctx.saved_tensors, *ctx.options)
        found = arguments.of_sums(sums.contiguous(), Wanted(ctx.screen_numbers, ctx.needs_input_grad[6]))
        g_cameras = found.cameras.view(*arguments.lead, 4, 4) if ctx.needs_input_grad[6] else None
        g_screen = None
        if ctx.screen_numbers:
            g_screen = found.screen.view(*arguments.lead, arguments.scene.count, ctx.screen_numbers)
        return (*found.fields, None, g_cameras, None, None, None, None, None, g_screen)


class _Composite(torch.autograd.Function):
    """The State of a render, and what it was made from, to images. The gradient of splats is as _Project takes it."""

    @staticmethod
    def forward(ctx, splats, colours, lists, background, others, width, height, antialiased, absolute):
        ctx.options, ctx.absolute = (width, height, antialiased), absolute
        job = _Composite._job(others, background, ctx.options, State(splats, colours, lists))
        images = tuple(job.draw())
        ctx.save_for_backward(splats, colours, lists, background, *others, *images)
        ctx.set_materialize_grads(False)
        return images

    @staticmethod
    def backward(ctx, g_image, g_alpha, g_depth):
        splats, colours, lists, background, *others, image, alpha, depth = ctx.saved_tensors
        job = _Composite._job(others, background, ctx.options, State(splats, colours, lists))
        g_image = torch.zeros_like(image) if g_image is None else g_image
        sums, parts = job.sums(DenseImages(image, alpha, depth), DenseImages(g_image, g_alpha, g_depth), ctx.absolute)
        return sums, None, None, parts.view(*job.lead, -1, 3).sum(2), None, None, None, None, None

    @staticmethod
    def _job(others, background, options, state):
        return DenseJob(*others[:5], background, *others[5:], *options, state=state)
