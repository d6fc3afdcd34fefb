"""Ordinary images of many views without gradients: some views at a time, so that no more than those are held."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lightfield_gs.rasterizer.dense_job import PINHOLE, Aperture, DenseArguments, DenseImages, DenseJob
from lightfield_gs.rasterizer.stats import Stats

# Of what is held beside the images: views go in parts that take about so much, or one at a time if one takes more
PART_BYTES = 1 << 29
# Numbers for a splat in one view: itself, its colour, its place in the order, and its pairs where it has a few
_SPLAT_NUMBERS = 48


def dense_in_parts(
    fields: list[Tensor],
    background: Tensor,
    views: list[Tensor],
    width: int,
    height: int,
    antialiased: bool,
    *,
    alpha: bool = False,
    depth: bool = False,
    stats: Stats | None = None,
    threads: int | None = None,
    aperture: Aperture = PINHOLE,
) -> DenseImages:
    """What render_dense draws of one scene: image [1, V, H, W, 3], and alpha and depth [1, V, H, W] if asked for.

    fields, background and views as render_dense takes them, with B = 1. Of V images of H x W pixels and N Gaussians it
    takes 12 + 4 (alpha) + 4 (depth) bytes a pixel (of float32) for the images, and beside them those of as many views
    as fit PART_BYTES, each 192 N bytes, and 4 a pixel for each of alpha and depth that is not asked for. Every bit is
    that of render_dense. Raises InputError.
    """
    arguments: list[Any] = [*fields, *views, width, height, antialiased]
    whole = DenseArguments(*arguments, aperture=aperture)
    scene, count = whole.scene, whole.images
    image = scene.new(1, count, height, width, 3)
    found = [scene.new(1, count, height, width) if wanted else None for wanted in (alpha, depth)]
    unasked = sum(t is None for t in found) * width * height
    of_one = image.element_size() * (_SPLAT_NUMBERS * scene.count + unasked)
    step = max(1, PART_BYTES // max(of_one, 1))
    for first in range(0, count, step):
        part = slice(first, first + step)
        one = Stats(device=None if stats is None else stats.device)
        job = DenseJob.of(
            *fields,
            background[:, part],
            *(t[:, part] for t in views),
            width,
            height,
            antialiased,
            stats=one,
            threads=threads,
            aperture=aperture,
        )
        drawn = job.draw(DenseImages(image[:, part], *(None if t is None else t[:, part] for t in found)))
        if stats is not None:
            one.add_buffers(*(t for t, mine in zip(drawn[1:], found) if mine is None and t is not None))
            stats.add_render(one)
        del job, drawn  # or the next part would be held beside this one
    return DenseImages(image, *found)


def divide_by_alpha(depth: Tensor, alpha: Tensor) -> Tensor:
    """The expected depth [1, V, H, W] from the sum of weight * z, in its place: a view at a time, whose temporary is
    all that it takes."""
    for of_view, coverage in zip(depth[0], alpha[0]):
        torch.div(of_view, coverage.clamp_min(1e-10), out=of_view)
    return depth
