"""Pruning by contribution: a scene without the Gaussians that hardly show on a panel."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import torch
from torch import Tensor

from lightfield_gs.base.checks import expect, real_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.base.options import Output
from lightfield_gs.encoding.encode import encode
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians, from_tensors


def prune(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    contribution_cut: float,
    antialiased: bool = False,
    view_filter: float = 0.0,
) -> Gaussians:
    """Remove the Gaussians that contribute least to the image of a scene on a panel by a rig.

    A Gaussian contributes its weights, alpha times the transmittance before it, in all sub-pixels. The Gaussians with
    the smallest sums are left out, while their total stays within contribution_cut of the sum of an opaque image. For
    colours in 0..1 and any background the mean absolute error against the whole scene is then at most contribution_cut
    + 1e-4. The 1e-4 is the transmittance at which samples end. A sample errs by at most the sum of the weights left out
    there. Proof: remove the Gaussians one by one, the farthest first. Each still has its weight w in a sample, and the
    Gaussians behind show in its place: the sample changes by w (behind - own colour).

    Pruning takes the time and memory of a training step on one image of the panel. Viewpoints outside the rig may show
    gaps.

    Args:
        gaussians: [N, ...], float32, or float64 on the CPU.
        panel: the panel of the image.
        rig: the viewpoints.
        contribution_cut: 0..1.
        antialiased: for scenes trained with anti-aliasing, see `render`.
        view_filter: of the image, see `encode`.

    Raises:
        InputError: for arguments of other types or values.
    """
    contribution_cut = real_number("contribution_cut", contribution_cut, 0.0, 1.0)
    weights = contributions(gaussians, panel, rig, antialiased, view_filter)
    kept = ~left_out(weights, panel, contribution_cut)
    return gaussians[kept]


def left_out(weights: Tensor, panel: Panel, contribution_cut: float) -> Tensor:
    """Return [N] bool: which Gaussians `prune` leaves out, by their contributions [N]."""
    ascending = weights.sort(stable=True)
    fits = ascending.values.cumsum(0) <= contribution_cut * 3 * panel.width_px * panel.height_px
    return torch.zeros_like(fits).index_copy_(0, ascending.indices, fits)


def contributions(
    gaussians: Gaussians, panel: Panel, rig: Rig, antialiased: bool = False, view_filter: float = 0.0
) -> Tensor:
    """Return [N] float64: each Gaussian's weights in the image of a panel, summed over all sub-pixels.

    That is the derivative of the sum of the image by its colour. Raises InputError.
    """
    for name, value, kind in (
        ("gaussians", gaussians, Gaussians),
        ("panel", panel, Panel),
        ("rig", rig, Rig),
        ("antialiased", antialiased, bool),
    ):
        expect(name, value, kind)
    gaussians.validate_layout()
    if gaussians.is_batched:
        raise InputError(f"contributions are of one scene, means [N, 3], got {list(gaussians.means.shape)}")
    output = cast(Output, str(gaussians.dtype).removeprefix("torch."))
    return summed_weights(
        gaussians,
        lambda scene: encode(scene, panel, rig, output=output, antialiased=antialiased, view_filter=view_filter),
    )


def summed_weights(gaussians: Gaussians, draw: Callable[[Gaussians], Tensor]) -> Tensor:
    """Return [N] float64: each Gaussian's weights in what `draw` draws, summed over all samples."""
    means, *shape, _ = (field.detach() for field in gaussians.fields().values())
    grey = torch.zeros(gaussians.count, 1, 3, dtype=means.dtype, device=means.device)
    with torch.inference_mode(False), torch.enable_grad():
        means, *shape, grey = (t.clone() if t.is_inference() else t for t in (means, *shape, grey))
        image = draw(from_tensors((means, *shape, grey.requires_grad_())))
        (gradient,) = torch.autograd.grad(image, grey, torch.ones_like(image))
    return gradient.double().sum((1, 2)) / SH_CONSTANT
