"""The sub-pixels of a panel as a torch operator with its backward: torch.ops.lightfield_gs.render_lens."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from lightfield_gs.rasterizer.autograd import differentiable_once
from lightfield_gs.rasterizer.lenticular_camera import LensView
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.scene import Scene, check
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.rasterizer.workspace import Workspace, workspace_of

# Orders of the polynomials for colours that vary over a rig. float64 takes the higher one: it is there to be exact
COLOUR_ORDER, EXACT_COLOUR_ORDER = 8, 16


class LensJob:
    """One light-field image to be drawn.

    fields: means [N,3], quaternions, scales, opacities and sh of one scene. background: [3]. view: what the panel's
    sub-pixels see. antialiased: see encoding.encode. Raises InputError for tensors of other shapes, types or devices.
    """

    def __init__(self, fields: Iterable[Tensor], background: Tensor, view: LensView, antialiased: bool = False):
        self.scene = Scene(*(t.unsqueeze(0) for t in fields))
        self.background = check("background", background, (3,), self.scene)
        self.view, self.antialiased, self.native = view, antialiased, view.native(antialiased)
        self.compensated = antialiased or view.aperture > 0  # whether opacities are lowered for what widens footprints
        self.width, self.height = view.lens.width_px, view.lens.height_px
        exact = background.dtype == torch.float64
        self.colour_order = 0 if self.scene.degree == 0 else EXACT_COLOUR_ORDER if exact else COLOUR_ORDER

    def image(self, as_bytes: bool = False) -> Tensor:
        """Memory for the image [H, W, 3], of the scene's dtype or, with as_bytes, uint8."""
        return self.scene.new(self.height, self.width, 3, dtype=torch.uint8 if as_bytes else None)

    def workspace(self, stats: Stats, threads: int, quality: Quality = EXACT) -> Workspace:
        """The workspace after all stages up to the composite."""
        with self.scene.guard:
            with stats.stage("project"):
                work = workspace_of(
                    self.scene,
                    1,
                    self.width,
                    self.height,
                    stats,
                    threads,
                    lens=True,
                    colour_order=self.colour_order,
                    compensated=self.compensated,
                )
                stats.colour_error = work.project_lens(self.native, quality)
            work.order_and_bin()
        return work


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
