"""A scene with fewer Gaussians, whose light field on a panel stays within a bound of its error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour
from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.encoding.encode import encode
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.scene.gaussians import Gaussians
from lightfield_gs.simplification.footprints import Eyes
from lightfield_gs.simplification.merging import MergedScene
from lightfield_gs.simplification.pruning import contributions

MOST_DB = 100.0  # of light fields that are equal
_STEP = 0.75  # fraction of the Gaussians that each step of the search keeps
_HALVINGS = 3  # of the last step, once it is too large: the count is then exact to 3 %


@dataclass(frozen=True)
class SimplifiedScene:
    """The result of simplify.

    Attributes:
        gaussians: the scene, on the device of the whole one.
        psnr_db: of its light field against the whole scene's, dB, 100 at most.
    """

    gaussians: Gaussians
    psnr_db: float


def simplify(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    *,
    psnr_db: float | None = None,
    count: int | None = None,
    background: Colour = (1.0, 1.0, 1.0),
    antialiased: bool = False,
    view_filter: float = 0.0,
    progress: Callable[[int, float], None] = lambda count, psnr_db: None,
) -> SimplifiedScene:
    """Merge and drop Gaussians, the cheapest for the light field of a panel first.

    The error is measured, not predicted: the whole panel is drawn at each step of the search. Viewpoints outside the
    rig may show gaps.

    Args:
        gaussians: one scene, [N, ...], float32.
        panel: the panel of the image.
        rig: the viewpoints.
        psnr_db: the least PSNR of the light field against the whole scene's, 0..100 dB, over all sub-pixels.
        count: the most Gaussians that are left, 1 or more. With both the count is kept, and so is the PSNR where it
            asks for more Gaussians.
        background: of the light field.
        antialiased: for scenes trained with anti-aliasing, see `render`.
        view_filter: of the light field, see `encode`.
        progress: called with the count and the PSNR of every step.

    Raises:
        InputError: for arguments of other types or values.
    """
    expect("gaussians", gaussians, Gaussians)
    least = 0.0 if psnr_db is None else real_number("psnr_db", psnr_db, 0.0, MOST_DB)
    target = 1 if count is None else whole_number("count", count, 1, 1 << 31)
    source = gaussians.detach().to(dtype=torch.float32)

    def drawn(scene: Gaussians) -> Tensor:
        return encode(
            scene, panel, rig, output="float32", background=background, antialiased=antialiased, view_filter=view_filter
        )

    weights = contributions(source, panel, rig, antialiased, view_filter) / 3  # three sub-pixels of a pixel
    merged = MergedScene(source, weights, Eyes.of(panel, rig, source.device))
    truth, best = drawn(source), SimplifiedScene(source, MOST_DB)
    if psnr_db is None:
        merged.reduce(target)
        scene = merged.scene()
        return SimplifiedScene(scene, light_field_psnr_db(drawn(scene), truth))
    kept, too_few, halvings = merged, None, _HALVINGS  # a scene that is good enough, a count that is not
    while halvings:
        wanted = int(kept.count * _STEP) if too_few is None else (kept.count + too_few) // 2
        halvings -= too_few is not None
        trial = kept.copy()
        trial.reduce(max(target, wanted))
        scene = trial.scene()
        psnr = light_field_psnr_db(drawn(scene), truth)
        progress(scene.count, psnr)
        if psnr < least:
            too_few = trial.count
            continue
        kept, best = trial, SimplifiedScene(scene, psnr)
        if scene.count <= target:
            break
    return best


def light_field_psnr_db(image: Tensor, truth: Tensor) -> float:
    """Return the PSNR of a light-field image against another, colours of 0..1, dB; MOST_DB at most."""
    error = sum(float((a.double() - b.double()).square().sum()) for a, b in zip(image.split(64), truth.split(64)))
    return float(-10 * torch.tensor(error / image.numel()).clamp_min(10 ** (-MOST_DB / 10)).log10())
