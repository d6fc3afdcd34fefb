"""A light-field image as a function of its Gaussians and of the numbers of its panel and rig.

A sub-pixel at D sees the camera at the normalized offset s = s_start + s_step x, with x = N frac(D / P_e). So ds/dD =
s_step N / P_e, and ds/dP_e = -D/P_e ds/dD, except where a lens ends. The stages have sums over sub-pixels of the
gradient by s, and the gradients of the rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lightfield_gs.base.errors import InputError
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.lenticular_camera import Lens, LenticularCamera
from lightfield_gs.rasterizer.operators import differentiable_once
from lightfield_gs.rasterizer.workspace import OpticsGradients


def render_with_optics(
    fields: Sequence[Tensor],
    background: Tensor,
    camera: LenticularCamera,
    antialiased: bool,
    rig: Tensor,
    lens: Sequence[Tensor],
) -> Tensor:
    """Draw the image [H, W, 3] of a camera with gradients to its numbers.

    Args:
        fields: means, quaternions, scales, opacities and sh of one scene.
        background: [3].
        camera: of the panel's sub-pixels; its values are drawn.
        antialiased: see encoding.encode.
        rig: [16 + RIG_OPTICS] float64 on the CPU, the same values: world_to_camera, then as csrc/math/projection.h
            lists Optic.
        lens: likewise line number, slant, phase, and [4, 4, 3] the places of sub-pixels: D from D of their pixel.

    Raises:
        InputError: for tensors of other shapes, types or devices, and for a rig without width.
    """
    if camera.lens.offset_step == 0:
        raise InputError("optics: a cone of 0 degrees has no gradients: give a larger one")
    return _Image.apply(camera, antialiased, rig, *lens, background, *fields)


class _Image(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, antialiased, *tensors):
        *_, background, means, quaternions, scales, opacities, sh = tensors
        render = DirectRender((means, quaternions, scales, opacities, sh), background, camera, antialiased)
        image = render.draw_exactly()
        ctx.render = render
        ctx.save_for_backward(*tensors, image)
        return image

    @staticmethod
    @differentiable_once
    def backward(ctx, g_image: Tensor) -> tuple[Any, ...]:
        _, _, slant, phase, places, *_, image = ctx.saved_tensors
        render, lens = ctx.render, ctx.render.camera.lens
        fields, g_background, optics = render.backward(image, g_image, optics=True)
        assert optics is not None
        g_lens = _lens_gradients(lens, float(slant), float(phase), places, optics)
        return None, None, optics.rig, *g_lens, g_background, *fields


def _lens_gradients(
    lens: Lens, slant: float, phase: float, places: Tensor, optics: OpticsGradients
) -> tuple[Tensor, ...]:
    """Return the gradients of line number, slant, phase and places.

    Args:
        lens: The lens.
        slant: Of the lens.
        phase: Of the lens, sub-pixels.
        places: [PERIOD, PERIOD, 3], see render_with_optics.
        optics: The gradients of the camera.
    """
    g_slant, g_phase = 3 * optics.by_row, optics.places.sum()
    times_d = 3 * optics.by_column + slant * g_slant + phase * g_phase + (optics.places * places).sum()
    half_width = max(abs(lens.offset_start), abs(lens.offset_start + lens.offset_step * lens.views))
    per_subpixel = lens.offset_step / half_width * lens.views / lens.line_number
    return tuple(per_subpixel * g for g in (-times_d / lens.line_number, g_slant, g_phase, optics.places))
