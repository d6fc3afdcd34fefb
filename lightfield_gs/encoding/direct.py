"""The method `direct`: the sub-pixels alone, by one projection and one sort for all cameras of a rig."""

from __future__ import annotations

import torch
from torch import Tensor

from lightfield_gs.base.options import Output
from lightfield_gs.encoding.arguments import refuse_with_gradients, wants_gradients
from lightfield_gs.rasterizer.lens import draw_lens
from lightfield_gs.rasterizer.lens_job import LensJob
from lightfield_gs.rasterizer.lens_view import LensView
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.scene.gaussians import Gaussians


def encode_direct(
    gaussians: Gaussians,
    view: LensView,
    background: Tensor,
    output: Output,
    quality: Quality,
    threads: int | None,
    stats: Stats | None,
    out: Tensor | None,
    antialiased: bool,
) -> Tensor:
    """The image [H, W, 3], by the operator that has a reverse where gradients are wanted. See encode.

    Raises InputError for arguments that this operator does not have.
    """
    fields = list(gaussians.fields().values())
    if wants_gradients(gaussians, background, output):
        refuse_with_gradients(
            quality=not quality.is_exact, threads=threads is not None, stats=stats is not None, out=out is not None
        )
        return torch.ops.lightfield_gs.render_lens(*fields, background, *view.lists(), antialiased)
    stats = stats or Stats()
    with torch.no_grad():
        with stats.stage("plan"):
            job = LensJob(fields, background, view, antialiased)
        return draw_lens(job, output == "uint8", quality, stats, threads, out)
