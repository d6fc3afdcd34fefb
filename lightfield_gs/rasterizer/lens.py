"""The sub-pixels of a panel as a torch operator with its reverse: torch.ops.lightfield_gs.render_lens.

Its stages are project, order, bin and composite (docs/design.md); each sub-pixel is seen from the camera offset of its
own view. The result is deterministic: the same bits whatever the number of threads. On CUDA, images without gradients
are drawn as frames, see frame_cuda.py.
"""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs.rasterizer.first_derivatives import differentiable_once
from lightfield_gs.rasterizer.frame_cuda import frames_of
from lightfield_gs.rasterizer.lens_job import LensJob
from lightfield_gs.rasterizer.lens_view import LensView
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.scene import check
from lightfield_gs.rasterizer.stats import Stats


def draw_lens(
    job: LensJob,
    as_bytes: bool = False,
    quality: Quality = EXACT,
    stats: Stats | None = None,
    threads: int | None = None,
    out: Tensor | None = None,
) -> Tensor:
    """The image [H, W, 3] without gradients. as_bytes: uint8 = round(255 clamp(c, 0, 1)). Fills `stats`, and `out`
    where it is given: an image of that size and type, which the caller has checked.

    On CUDA the fast kernels of a frame draw it: within 1/255, except where a sample lies on a threshold, such as the
    alpha from which on a splat counts.
    """
    stats, threads = stats or Stats(), threads or torch.get_num_threads()
    if job.scene.device.type == "cuda":
        return frames_of(job, quality).draw(job, as_bytes, stats, out)
    work = job.workspace(stats, threads, quality)
    with stats.stage("composite"):
        out = job.image(as_bytes) if out is None else out
        work.composite_lens(job.native, quality, job.background, out)
    return out


def _job(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape, antialiased) -> LensJob:
    """The job of an operator's arguments, which has its view as three lists of numbers."""
    view = LensView.of_lists(rig, lens, lens_shape)
    return LensJob((means, quaternions, scales, opacities, sh), background, view, antialiased)


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
    the camera at offset s = offset_start + offset_step * x, with x its own view coordinate.
    rig: 26 or 27 numbers: world_to_camera (16, row-major), fx, fy, cx, cy, Jacobian limits (5, see Cameras.limits),
    zero_depth and, unless it is 0, the aperture (see LensView).
    lens: width, height, views, phase0, phase_x, phase_y (64-bit patterns as signed integers, 2^64 = one lens),
    bgr, continuous; of a panel with sub-pixel cells then 48 phases that its sub-pixels have beyond those of stripes, by
    row mod 4, column mod 4 and place, and 48 image channels, likewise. lens_shape: line_number, slant_tan, phase
    (sub-pixels), offset_start, offset_step (scene units). antialiased: see encoding.encode.
    lightfield_gs.encode builds them from a Panel and a Rig. Raises InputError.
    """
    job = _job(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape, antialiased)
    work, out = job.workspace(Stats(), torch.get_num_threads()), job.image()
    with job.scene.guard:
        work.composite_lens(job.native, EXACT, job.background, out)
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
    job = _job(means, quaternions, scales, opacities, sh, background, rig, lens, lens_shape, antialiased)
    image, g_image = (
        check(n, t, (job.height, job.width, 3), means) for n, t in (("image", image), ("g_image", g_image))
    )
    work = job.workspace(Stats(), torch.get_num_threads())
    with job.scene.guard:
        out, parts = work.lens_backward(job.native, job.background, image, g_image)
    g_means, g_quaternions, g_scales, g_opacities, g_sh = (g.squeeze(0) for g in out)
    return g_means, g_quaternions, g_scales, g_opacities, g_sh, parts.sum(0)


@render_lens_backward.register_fake
def _(means, quaternions, scales, opacities, sh, background, *rest):
    inputs = (means, quaternions, scales, opacities, sh, background)
    return tuple(torch.empty_like(t, memory_format=torch.contiguous_format) for t in inputs)


def _lens_setup(ctx, inputs, output):
    *tensors, ctx.rig, ctx.lens, ctx.lens_shape, ctx.antialiased = inputs
    ctx.save_for_backward(*tensors, output)


@differentiable_once
def _lens_backward(ctx, grad):
    *tensors, image = ctx.saved_tensors
    out = torch.ops.lightfield_gs.render_lens_backward(
        *tensors, ctx.rig, ctx.lens, ctx.lens_shape, image, grad, ctx.antialiased
    )
    return (*out, None, None, None, None)


render_lens.register_autograd(_lens_backward, setup_context=_lens_setup)
