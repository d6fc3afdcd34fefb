"""A scene to the sub-pixel-encoded image of a panel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour
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
from lightfield_gs.panels.lens import lenticular_camera, view_aperture
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.frame_cuda import frames_of
from lightfield_gs.rasterizer.image_render import PINHOLE
from lightfield_gs.rasterizer.lenticular_camera import LenticularCamera
from lightfield_gs.rasterizer.quality import EXACT, Quality
from lightfield_gs.rasterizer.scene import background_tensor
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
    """The image [H, W, 3], by the operator that has a reverse where gradients are wanted. See encode.

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
    """The image [H, W, 3] that the panel shows of a scene: each sub-pixel seen by the camera that it belongs to.

    method: "direct" renders only the sub-pixels (all cameras of the rig share one projection and one sort); "sorted"
    renders only the sub-pixels too, but view by view, with any cameras and any view map (Shi et al. 2025); "classic"
    renders one dense image per view and interlaces them, the usual way and the cross-check of the others.
    views: "integer": camera at floor(x) + 1/2; "continuous": at the exact x of the sub-pixel.
    Only for "sorted": cameras [N] at the panel's resolution, the right-most eye's first, in place of the rig's;
    view_map int32 [H, W, 3] by image channel, which of the N cameras each sub-pixel shows, or -1 for the background
    (or a SortedPlan made of such a map, to sort only once), in place of the panel's; memory_budget: bytes that the work
    memory may take on the device of the Gaussians, beside what is given and the image (None: the plan and 256 MiB, or
    1 GiB on CUDA); on CUDA those asked of torch's allocator, which may round each buffer up.
    output: "uint8" = round(255 clamp(c, 0, 1)), "float32" or "float64" (computed in that precision); float outputs of
    "direct" and "classic" are differentiable once in the five fields of the Gaussians and in the background. Where
    gradients are wanted, quality, threads, stats, out and, of "classic", view_filter are refused, and so is "sorted".
    quality: "exact", "high", "fast", "draft" or a Quality, of "direct": how much error is allowed for less time.
    threads: CPU threads, 1..1024 (default: torch's).
    stats: a dict to fill with stages_ms (on CUDA the stages then wait for each other), pairs, evaluations,
    evaluations_per_subpixel (both None on CUDA), work_bytes, gaussians_culled, colour_error; for "direct" also skipped:
    Gaussians not drawn by reason, tiles from lattices, lattices and, on the CPU, samples that ended early and orders of
    colours, while on CUDA the kernel that the frame chose; for "sorted" also memory_bytes and memory_bytes_unchunked,
    by stage: geometry, image (the sorted sub-pixels), binning; of the largest chunk of views, and of all views at once.
    out: of "direct", an image of the same size, type and device, e.g. of the frame before, that is drawn over and
    returned: on a CPU a new one of 88 MB costs 10 to 25 ms, for the system to find its memory.
    antialiased: for scenes that were trained so, see `render`; of any method. "direct" takes up to half as long again,
    and on CUDA draws them neither from lattices nor in half precision, whatever the quality.
    view_filter: of any method with a rig, angular anti-aliasing: how many views wide a box of camera positions each
    sub-pixel's picture is averaged over; 0: none, 1: as wide as a view. What moves between views by more than its own
    size no longer shows as separate copies to an eye between them, and is blurred along the rows instead (Zwicker et
    al., "Antialiasing for automultiscopic 3D displays", 2006); splats in the zero plane stay sharp. Each splat is
    widened by the variance of the box and keeps its light by a lower opacity. Takes as long as antialiased.
    Raises InputError.
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
