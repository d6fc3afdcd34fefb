"""A scene to the sub-pixel-encoded image of a panel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, background_tensor
from lightfield_gs.base.options import Method, Output, QualityName, Views
from lightfield_gs.encoding.arguments import (
    DTYPES,
    check_options,
    check_out,
    check_together,
    check_types,
    check_view_filter,
    refuse_gradients,
    refuse_with_gradients,
    wants_gradients,
)
from lightfield_gs.encoding.classic import classic_with_gradients, encode_classic
from lightfield_gs.encoding.sorted import cameras_and_plan, encode_sorted
from lightfield_gs.encoding.sorted_plan import SortedPlan
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig, lenticular_camera, view_aperture
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.frame_cuda import known_frames
from lightfield_gs.rasterizer.lenticular_camera import PINHOLE, LenticularCamera
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.stats import Stats, count_culled
from lightfield_gs.scene.cameras import Cameras, recentre
from lightfield_gs.scene.gaussians import Gaussians


def encode_direct(
    gaussians: Gaussians,
    camera: LenticularCamera,
    background: Tensor,
    output: Output,
    quality: Quality,
    threads: int | None,
    stats: Stats | None,
    out: Tensor | None,
    antialiased: bool,
) -> Tensor:
    """Draw the image [H, W, 3], by the operator that has a backward where gradients are wanted. See encode.

    Raises InputError for arguments that this operator does not have.
    """
    fields = list(gaussians.fields().values())
    if wants_gradients(gaussians, background, output):
        refuse_with_gradients(
            quality=not quality.is_exact, threads=threads is not None, stats=stats is not None, out=out is not None
        )
        return torch.ops.lightfield_gs.render_direct(*fields, background, *camera.numbers(), antialiased)
    stats = stats or Stats()
    with torch.no_grad():
        with stats.stage("plan"):
            job = DirectRender(fields, background, camera, antialiased)
        return draw_direct(job, output == "uint8", quality, stats, threads, out)


def draw_direct(
    job: DirectRender,
    as_bytes: bool = False,
    quality: Quality = EXACT,
    stats: Stats | None = None,
    threads: int | None = None,
    out: Tensor | None = None,
) -> Tensor:
    """Draw the image [H, W, 3] without gradients.

    On CUDA the fast kernels of a frame draw it. They err by up to 1/255, except where a sample lies on a threshold,
    such as the least alpha of a splat.

    Args:
        job: the render.
        as_bytes: whether the image is uint8 = round(255 clamp(c, 0, 1)).
        quality: how much error is allowed.
        stats: filled with times and counts.
        threads: of the CPU; None: torch's.
        out: an image of that size and type, which the caller has checked.
    """
    stats, threads = stats or Stats(), threads or torch.get_num_threads()
    if job.scene.device.type == "cuda":
        return known_frames(job, quality).draw(job, as_bytes, stats, out)
    work = job.workspace(stats, threads, quality)
    with stats.stage("composite"):
        out = job.new_image(as_bytes) if out is None else out
        work.composite_direct(job.native, quality, job.background, out)
    return out


def encode(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig | None = None,
    method: Method = "direct",
    *,
    views: Views = "integer",
    cameras: Cameras | None = None,
    view_map: np.ndarray | Tensor | SortedPlan | None = None,
    memory_budget: int | None = None,
    background: Colour = (1.0, 1.0, 1.0),
    output: Output = "uint8",
    quality: QualityName | Quality = "exact",
    threads: int | None = None,
    stats: dict[str, Any] | None = None,
    out: Tensor | None = None,
    antialiased: bool = False,
    view_filter: float = 0.0,
) -> Tensor:
    """Draw the image [H, W, 3] of a scene for a panel. The camera of a view sees the sub-pixels of this view.

    Args:
        gaussians: one scene, [N, ...].
        panel: its lens determines the view of each sub-pixel.
        rig: the fan of cameras behind the views; not needed by "sorted" with cameras.
        method: "direct" renders only the sub-pixels; all cameras of the rig share one projection and one sort. "sorted"
            also renders only the sub-pixels, view by view, with any cameras and any view map (Shi et al. 2025).
            "classic" renders one image per view and interlaces them: the usual way, and the cross-check of the other
            methods.
        views: "integer": the camera at floor(x) + 1/2; "continuous": at the exact x of the sub-pixel.
        cameras: of "sorted", in place of the rig's: [N] at the panel's resolution, the right-most eye's first.
        view_map: of "sorted", in place of the panel's: int32 [H, W, 3] by image channel. Its values are the camera,
            0..N - 1, that each sub-pixel shows, or -1 for the background. A SortedPlan made of such a map is sorted
            only once.
        memory_budget: of "sorted": bytes of work memory on the device of the Gaussians, beside arguments and image.
            None: the plan and 256 MiB, or on CUDA 1 GiB. On CUDA torch's allocator may round each buffer up.
        background: three numbers in 0..1, or a tensor of three.
        output: "uint8" = round(255 clamp(c, 0, 1)), "float32", or "float64", which is computed in that precision. Float
            outputs of "direct" and "classic" are differentiable once in the five fields and in the background. With
            gradients these are refused: "sorted", quality, threads, stats, out, and view_filter of "classic".
        quality: of "direct": "exact", "high", "fast", "draft" or a Quality: how much error is allowed for less time.
        threads: of the CPU, 1..1024; None: torch's.
        stats: a dict to fill with stages_ms, pairs, evaluations, evaluations_per_subpixel, work_bytes, gaussians_culled
            and colour_error. On CUDA the stages then wait for each other, and evaluations are not counted (None).
            "direct" adds skipped: Gaussians not drawn by reason, tiles and lattices. On the CPU it also has samples
            that ended early and orders of colours, on CUDA the kernel. "sorted" adds memory_bytes, the bytes of the
            largest chunk of views, and memory_bytes_unchunked, the bytes of all views at once. Their stages are
            geometry, image (the sorted sub-pixels) and binning.
        out: of "direct": an image of the same size, type and device to overwrite and return, such as the frame before.
            On a CPU the allocation of a new image of 88 MB costs 10 to 25 ms.
        antialiased: for scenes trained with anti-aliasing, see `render`; any method. "direct" takes up to 50 % longer.
            On CUDA it then uses neither lattices nor half precision at any quality.
        view_filter: width of angular anti-aliasing, in views; 0: none. Any method with a rig. Each sub-pixel is
            averaged over a box of camera positions of this width. Points that move between views by more than their
            size then blur along the rows. Without the filter an eye between views sees separate copies. The zero plane
            stays sharp (Zwicker et al., "Antialiasing for automultiscopic 3D displays", 2006). Each splat is widened by
            the variance of the box, and its opacity is lowered by the compensation. Takes as long as antialiased.

    Returns:
        The image, of the type of `output`.

    Raises:
        InputError: an argument has a wrong type, shape or value, or belongs to another method.
    """
    check_options(method, views, output)
    check_types(gaussians, panel, rig, cameras, stats, antialiased)
    view_filter = check_view_filter(view_filter, cameras)
    quality, continuous, as_bytes = Quality.of(quality), views == "continuous", output == "uint8"
    threads, memory_budget = check_together(
        method, views, output, rig, quality, threads, memory_budget, cameras=cameras, view_map=view_map, out=out
    )
    if out is not None:
        check_out(out, output, panel, gaussians.device)
    gaussians = gaussians.to(dtype=torch.float64 if output == "float64" else torch.float32)
    colour = background_tensor(background, gaussians.means).reshape(-1)
    follows = wants_gradients(gaussians, colour, output, cameras)
    if follows and method == "sorted":
        refuse_gradients("method 'sorted'")
    counters = Stats(device=gaussians.device if stats is not None else None)
    if method == "direct":
        camera = lenticular_camera(panel, cast(Rig, rig), continuous, view_filter)
        counted = None if stats is None else counters
        image = encode_direct(gaussians, camera, colour, output, quality, threads, counted, out, antialiased)
    elif method == "classic" and follows:
        refuse_with_gradients(threads=threads is not None, stats=stats is not None, view_filter=view_filter > 0)
        return classic_with_gradients(gaussians, panel, cast(Rig, rig), continuous, colour, antialiased)
    elif method == "classic":
        image = encode_classic(
            gaussians,
            panel,
            cast(Rig, rig),
            continuous,
            colour,
            DTYPES[output],
            threads,
            counters,
            antialiased,
            view_aperture(panel, cast(Rig, rig), view_filter),
        )
    else:
        with counters.stage("plan"):
            seen, plan = cameras_and_plan(panel, rig, cameras, view_map, continuous, gaussians.device)
        means, seen = recentre(gaussians.means, seen)
        gaussians = replace(gaussians, means=means)
        aperture = PINHOLE if rig is None else view_aperture(panel, rig, view_filter)
        image = encode_sorted(
            gaussians, seen, plan, memory_budget, colour, as_bytes, threads, counters, antialiased, aperture
        )
    if stats is not None:
        stats.update(counters.report(gaussians.count, image.numel()))
        if method == "direct":
            drawn = gaussians.count - stats["gaussians_culled"]
            culled = count_culled(gaussians, cast(Rig, rig).world_to_camera, drawn, counters.pruned)
            stats["skipped"] = {"gaussians": culled, **counters.skipped}
    return image
