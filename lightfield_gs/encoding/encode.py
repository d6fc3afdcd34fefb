"""A scene to the sub-pixel-encoded image of a panel."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, dense_tensor
from lightfield_gs.base.checks import expect, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import METHODS, OUTPUTS, VIEWS, Method, Output, QualityName, Views, of_other_methods
from lightfield_gs.encoding.classic import encode_classic
from lightfield_gs.encoding.sorted import cameras_and_plan, encode_sorted
from lightfield_gs.encoding.sorted_plan import SortedPlan
from lightfield_gs.panels.lens import lens_view
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer import skips
from lightfield_gs.rasterizer.images import background_tensor
from lightfield_gs.rasterizer.lens import draw_lens
from lightfield_gs.rasterizer.lens_job import LensJob
from lightfield_gs.rasterizer.lens_view import LensView
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.stats import Stats
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

_DTYPES: dict[Output, torch.dtype] = {name: getattr(torch, name) for name in OUTPUTS}
MOST_THREADS = 1024
_MOST_BYTES = 1 << 62
_BY_A_RIG = ": the other methods draw the panel's own views by a rig"
_WHY_NOT = {
    "cameras": _BY_A_RIG,
    "view_map": _BY_A_RIG,
    "memory_budget": _BY_A_RIG,
    "quality": ": that is exact only",
    "out": "",
}


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
    "direct" are differentiable; where gradients are wanted, quality, threads, stats and out are refused.
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
    Raises InputError.
    """
    check_options(method, views, output)
    for name, value, kinds in (
        ("gaussians", gaussians, (Gaussians,)),
        ("panel", panel, (Panel,)),
        ("rig", rig, (Rig, type(None))),
        ("cameras", cameras, (Cameras, type(None))),
        ("stats", stats, (dict, type(None))),
        ("antialiased", antialiased, (bool,)),
    ):
        expect(name, value, *kinds)
    gaussians.validate_layout()
    quality = Quality.of(quality)
    if gaussians.is_batched:
        raise InputError(f"encode takes one scene, means [N, 3], got {list(gaussians.means.shape)}")
    if not (gaussians.means.is_cuda and torch.cuda.is_current_stream_capturing()):
        gaussians.validate()  # looking at values waits for the device
    if threads is not None:
        threads = whole_number("threads", threads, 1, MOST_THREADS)
    if memory_budget is not None:
        memory_budget = whole_number("memory_budget (bytes)", memory_budget, 1, _MOST_BYTES)
    for name, its in of_other_methods(
        method,
        cameras=cameras,
        view_map=view_map,
        memory_budget=memory_budget,
        quality=None if quality.is_exact else quality,
        out=out,
    ):
        raise InputError(f"{name}= is for method {its!r}, not {method!r}{_WHY_NOT[name]}")
    if method != "sorted" and rig is None:
        raise InputError(f"method {method!r} needs a rig (Rig.frame makes one)")
    if memory_budget is not None and views == "continuous":
        raise InputError(
            "memory_budget goes with integer views: cameras for all distinct places within a lens have no "
            "bound; use method direct, which takes little memory, or integer views"
        )
    if not quality.is_exact and output == "float64":
        raise InputError("quality is for output 'uint8' or 'float32', not 'float64': that is exact only")
    if out is not None:
        _check_out(out, output, panel, gaussians.device)
    precision = torch.float64 if output == "float64" else torch.float32
    gaussians = gaussians.to(dtype=precision)
    colour = background_tensor(background, gaussians.means).reshape(-1)
    counters = Stats(device=gaussians.device if stats is not None else None)
    if method == "classic":
        image = encode_classic(
            gaussians,
            panel,
            cast(Rig, rig),
            views == "continuous",
            colour,
            _DTYPES[output],
            threads,
            counters,
            antialiased,
        )
    elif method == "sorted":
        with counters.stage("plan"):
            chosen = cameras_and_plan(panel, rig, cameras, view_map, views == "continuous", gaussians.device)
        image = encode_sorted(
            gaussians.fields().values(),
            *chosen,
            memory_budget,
            colour,
            output == "uint8",
            threads or torch.get_num_threads(),
            counters,
            antialiased,
        )
    elif _wants_gradients(output, gaussians, colour):
        _refuse_with_gradients(
            quality=not quality.is_exact, threads=threads is not None, stats=stats is not None, out=out is not None
        )
        image = torch.ops.lightfield_gs.render_lens(
            *gaussians.fields().values(),
            colour,
            *lens_view(panel, cast(Rig, rig), views == "continuous").lists(),
            antialiased,
        )
    else:
        image = _direct(
            gaussians,
            lens_view(panel, cast(Rig, rig), views == "continuous"),
            colour,
            output,
            quality,
            threads,
            counters,
            out,
            antialiased,
        )
    if stats is not None:
        _report(counters, gaussians, panel, stats)
        if method == "direct":
            drawn = gaussians.count - stats["gaussians_culled"]
            stats["skipped"] = {
                "gaussians": skips.culled(gaussians, cast(Rig, rig).world_to_camera, drawn, counters.pruned),
                **counters.skipped,
            }
    return image


def _check_out(out: Tensor, output: Output, panel: Panel, device: torch.device) -> None:
    """Raises InputError for what an image cannot be drawn over."""
    expect("out", out, Tensor)
    expected = (panel.height_px, panel.width_px, 3), _DTYPES[output], device
    if (tuple(out.shape), out.dtype, out.device) != expected or not out.is_contiguous() or out.requires_grad:
        raise InputError(
            f"out must be a contiguous {expected[1]} tensor {list(expected[0])} on {device} without "
            f"gradients, got {out.dtype} {list(out.shape)} on {out.device}, strides {out.stride()}"
            f"{', with gradients' if out.requires_grad else ''}"
        )
    if out.is_cuda and out.data_ptr() % 2:
        raise InputError(
            "out must begin at an even address on CUDA, got a part of another tensor at an odd one; give "
            "a tensor of its own"
        )


def check_options(method: str, views: str, output: str) -> None:
    """Raises InputError for what `encode` does not know."""
    for name, value in (("method", method), ("views", views), ("output", output)):
        expect(name, value, str)
    if method not in METHODS or views not in VIEWS or output not in OUTPUTS:
        raise InputError(
            f"encode takes method {METHODS}, views {VIEWS} and output {OUTPUTS}, got {method!r}, "
            f"{views!r} and {output!r}"
        )


def interlace(views: Tensor, panel: Panel) -> Tensor:
    """Takes every sub-pixel of a panel from the view that it belongs to: views [N, H, W, 3] -> [H, W, 3], same dtype.

    N = panel.views, H and W the panel's size. View 0 is the right-most eye's (with invert_views the left-most one's):
    tiles of a quilt, whose first is the left-most, are in the other order. Raises InputError.
    """
    views = dense_tensor("views", views)
    expect("panel", panel, Panel)
    expected = (panel.views, panel.height_px, panel.width_px, 3)
    if tuple(views.shape) != expected:
        raise InputError(f"views must be {list(expected)} for this panel, got {list(views.shape)}")
    numbers = torch.from_numpy(panel.view_map()).to(device=views.device, dtype=torch.int64)
    return views.gather(0, numbers.unsqueeze(0)).squeeze(0)


def _direct(
    gaussians: Gaussians,
    view: LensView,
    background: Tensor,
    output: Output,
    quality: Quality,
    threads: int | None,
    stats: Stats,
    out: Tensor | None,
    antialiased: bool,
) -> Tensor:
    """The image without gradients."""
    with torch.no_grad():
        with stats.stage("plan"):
            job = LensJob(gaussians.fields().values(), background, view, antialiased)
        return draw_lens(job, output == "uint8", quality, stats, threads, out)


def _wants_gradients(output: Output, gaussians: Gaussians, background: Tensor) -> bool:
    """Whether torch is to follow how an image came about; bytes have no gradients."""
    return (
        output != "uint8"
        and torch.is_grad_enabled()
        and any(t.requires_grad for t in (*gaussians.fields().values(), background))
    )


def _refuse_with_gradients(**given: bool) -> None:
    """Raises InputError for the first option that was given: the operator with gradients has none of them."""
    for name in (name for name, is_given in given.items() if is_given):
        raise InputError(f"{name}= is for images without gradients: use torch.no_grad(), or leave it out")


def _report(counters: Stats, gaussians: Gaussians, panel: Panel, out: dict[str, Any]) -> None:
    evaluations = None if gaussians.means.is_cuda else counters.evaluations
    per_subpixel = None if evaluations is None else evaluations / (3 * panel.width_px * panel.height_px)
    culled = gaussians.count - counters.gaussians_drawn // max(counters.images, 1)
    out.update(
        stages_ms=dict(counters.stages_ms),
        pairs=counters.pairs,
        evaluations=evaluations,
        evaluations_per_subpixel=per_subpixel,
        work_bytes=counters.work_bytes,
        gaussians_culled=culled,
        colour_error=counters.colour_error,
    )
    if counters.kernel is not None:
        out["kernel"] = counters.kernel
    if counters.memory_bytes:
        out.update(memory_bytes=counters.memory_bytes, memory_bytes_unchunked=counters.memory_bytes_unchunked)
