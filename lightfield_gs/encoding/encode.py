"""Rendering: ordinary images of Gaussians, and the sub-pixel-encoded image of a panel."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal, overload

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, bytes_of, dense_tensor
from lightfield_gs.base.checks import expect, shown, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import METHODS, OUTPUTS, VIEWS, Method, Output, QualityName, Views
from lightfield_gs.encoding.sorted import cameras_and_plan, encode_sorted
from lightfield_gs.encoding.sorted_plan import SortedPlan, views_shown
from lightfield_gs.panels.lens import lens_lists
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer import ops, skips
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.workspace import Stats
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

_DTYPES: dict[Output, torch.dtype] = {name: getattr(torch, name) for name in OUTPUTS}
MOST_THREADS = 1024
_MOST_BYTES = 1 << 62
_CLASSIC_PIXELS = 4_000_000  # rendered at a time: small images go in batches


@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[False] = ...,
    depth: Literal[False] = ...,
    antialiased: bool = ...,
) -> Tensor: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[True],
    depth: Literal[False] = ...,
    antialiased: bool = ...,
) -> tuple[Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[False] = ...,
    depth: Literal[True],
    antialiased: bool = ...,
) -> tuple[Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: Literal[True],
    depth: Literal[True],
    antialiased: bool = ...,
) -> tuple[Tensor, Tensor, Tensor]: ...
@overload
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = ...,
    alpha: bool = ...,
    depth: bool = ...,
    antialiased: bool = ...,
) -> Tensor | tuple[Tensor, ...]: ...
def render(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    background: Colour = (1.0, 1.0, 1.0),
    alpha: bool = False,
    depth: bool = False,
    antialiased: bool = False,
) -> Tensor | tuple[Tensor, ...]:
    """Ordinary images of Gaussians (Kerbl et al. 2023), differentiable.

    gaussians [N, ...] with cameras [C, ...]; or gaussians [B, N, ...] with cameras [B, C, ...], or with the same
    cameras [C, ...] for every set. float32 or float64.
    background: three numbers in 0..1, or a tensor that broadcasts to [..., C, 3], whose values need only be finite.
    Returns the image [..., C, H, W, 3]; with alpha and/or depth a tuple (image, alpha [..., C, H, W], depth
    [..., C, H, W]), depth being the expected view-space z of what is covered, 0 where nothing is.
    antialiased: for scenes that were trained so (Yu et al., Mip-Splatting, 2024; gsplat's rasterize_mode of that name):
    a Gaussian that 0.3 px^2 of blur spread out becomes fainter by as much, by the root of the ratio of the determinants
    of its projected covariance. Raises InputError.
    """
    expect("gaussians", gaussians, Gaussians)
    expect("cameras", cameras, Cameras)
    for name, value in (("alpha", alpha), ("depth", depth), ("antialiased", antialiased)):
        expect(name, value, bool)
    gaussians.validate_layout()
    if not gaussians.means.is_cuda:
        gaussians.validate()  # there, looking at values would wait for the device
    like, batched = gaussians.means, gaussians.is_batched
    views = [t.to(like) for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())]
    if cameras.world_to_camera.dim() == 3:
        views = [t.expand(like.shape[0] if batched else 1, *t.shape) for t in views]
    elif not batched:
        raise InputError(
            f"cameras [B, C, ...] go with batched Gaussians [B, N, ...], got means {list(like.shape)} and "
            f"cameras {list(cameras.world_to_camera.shape)}"
        )
    tensors = [t if batched else t.unsqueeze(0) for t in _tensors(gaussians)]
    colour = background_tensor(background, like).expand(*views[0].shape[:2], 3)
    draw = torch.ops.lightfield_gs.render_dense
    if not (torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors, colour, *views))):
        draw = ops.dense_forward  # the first call of an operator with a reverse has torch import for a second
    image, coverage, weighted_depth = draw(*tensors, colour, *views, cameras.width_px, cameras.height_px, antialiased)
    out = [image]
    if alpha:
        out.append(coverage)
    if depth:
        out.append(weighted_depth / coverage.clamp_min(1e-10))
    out = [t if batched else t.squeeze(0) for t in out]
    return tuple(out) if len(out) > 1 else out[0]


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
    _check_sorted_only(method, views, rig, cameras, view_map, memory_budget)
    if not quality.is_exact and (method != "direct" or output == "float64"):
        raise InputError(
            f"quality is for method 'direct' and output 'uint8' or 'float32', not {method!r} and "
            f"{output!r}: those are exact only"
        )
    if out is not None:
        _check_out(out, method, output, panel, gaussians.device)
    precision = torch.float64 if output == "float64" else torch.float32
    gaussians = gaussians.to(dtype=precision)
    colour = background_tensor(background, gaussians.means).reshape(-1)
    counters = Stats(device=gaussians.device if stats is not None else None)
    if method == "classic":
        image = _classic(gaussians, panel, rig, views, colour, output, threads, counters, antialiased)
    elif method == "sorted":
        with counters.stage("plan"):
            chosen = cameras_and_plan(panel, rig, cameras, view_map, views == "continuous", gaussians.device)
        image = encode_sorted(
            _tensors(gaussians),
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
            *_tensors(gaussians), colour, *lens_arguments(panel, rig, views == "continuous"), antialiased
        )
    else:
        image = _direct(gaussians, panel, rig, views, colour, output, quality, threads, counters, out, antialiased)
    if stats is not None:
        _report(counters, gaussians, panel, stats)
        if method == "direct":
            drawn = gaussians.count - stats["gaussians_culled"]
            stats["skipped"] = {
                "gaussians": skips.culled(gaussians, rig.world_to_camera, drawn, counters.pruned),
                **counters.skipped,
            }
    return image


def _check_out(out: Tensor, method: Method, output: Output, panel: Panel, device: torch.device) -> None:
    """Raises InputError for what an image cannot be drawn over."""
    expect("out", out, Tensor)
    if method != "direct":
        raise InputError(f"out is for method 'direct', not {method!r}")
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


def lens_arguments(panel: Panel, rig: Rig, continuous: bool) -> tuple[list[float], list[int], list[float]]:
    """rig, lens and lens_shape as torch.ops.lightfield_gs.render_lens takes them."""
    start, end = float(rig.offset(0, panel)), float(rig.offset(panel.views, panel))
    numbers = [
        *np.asarray(rig.world_to_camera, np.float64).reshape(-1).tolist(),
        *rig.focal_px,
        *rig.principal_point_px,
        *rig.jacobian_limits(panel),
        0.0,
        rig.zero_depth,
    ]
    return [float(v) for v in numbers], *lens_lists(panel, continuous, start, (end - start) / panel.views)


def _direct(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    views: Views,
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
        return ops.lens_forward(
            *_tensors(gaussians),
            background,
            *lens_arguments(panel, rig, views == "continuous"),
            antialiased,
            as_bytes=output == "uint8",
            quality=quality,
            stats=stats,
            threads=threads,
            out=out,
        )


def _wants_gradients(output: Output, gaussians: Gaussians, background: Tensor) -> bool:
    """Whether torch is to follow how an image came about; bytes have no gradients."""
    return (
        output != "uint8"
        and torch.is_grad_enabled()
        and any(t.requires_grad for t in (*_tensors(gaussians), background))
    )


def _refuse_with_gradients(**given: bool) -> None:
    """Raises InputError for the first option that was given: the operator with gradients has none of them."""
    for name in (name for name, is_given in given.items() if is_given):
        raise InputError(f"{name}= is for images without gradients: use torch.no_grad(), or leave it out")


@torch.no_grad()
def _classic(
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig,
    views: Views,
    background: Tensor,
    output: Output,
    threads: int | None,
    stats: Stats,
    antialiased: bool,
) -> Tensor:
    """One dense image per view that the panel shows; with continuous views, one per distinct x."""
    with stats.stage("plan"):
        places, x = _classic_plan(panel, views == "continuous", gaussians.device)
    tensors = [t.unsqueeze(0) for t in _tensors(gaussians)]
    pixels = panel.width_px * panel.height_px
    out = torch.empty(3 * pixels, dtype=_DTYPES[output], device=gaussians.device)
    chunk = max(1, _CLASSIC_PIXELS // pixels)
    for first in range(0, len(x), chunk):
        cameras = rig.cameras_at(panel, x[first : first + chunk]).to(gaussians.means)
        one = Stats(device=stats.device)
        images, alpha, depth = ops.dense_forward(
            *tensors,
            background.expand(1, cameras.count, 3),
            cameras.world_to_camera[None],
            cameras.intrinsics()[None],
            cameras.limits()[None],
            panel.width_px,
            panel.height_px,
            antialiased,
            stats=one,
            threads=threads,
        )
        one.add_buffers(images, alpha, depth)
        stats.add_render(one)
        with stats.stage("interlace"):
            if output == "uint8":
                images = bytes_of(images)
            _take_over(out, images.view(cameras.count, -1), places, first)
    return out.view(panel.height_px, panel.width_px, 3)


def _take_over(out: Tensor, images: Tensor, places: Tensor, first: int) -> None:
    """Into out [M]: the sub-pixels whose place is that of an image [C, M], first .. first + C - 1."""
    if len(images) == 1 and not out.is_cuda:  # half the time of what follows
        np.copyto(out.numpy(), images[0].numpy(), where=places.numpy() == first)
        return
    mine = ((places >= first) & (places < first + len(images))).nonzero().squeeze(1)
    out[mine] = images[places[mine].to(torch.int64) - first, mine]


@lru_cache(maxsize=1)  # of a panel at 8K this takes a second
def _classic_plan(panel: Panel, continuous: bool, device: torch.device) -> tuple[Tensor, np.ndarray]:
    """views_shown, the places on the device."""
    places, x = views_shown(panel, continuous)
    return torch.from_numpy(places).to(device), x


def _check_sorted_only(
    method: Method, views: Views, rig: Rig | None, cameras: Cameras | None, view_map: Any, memory_budget: int | None
) -> None:
    """Raises InputError where arguments of one method meet another."""
    if method != "sorted":
        for name, value in (("cameras", cameras), ("view_map", view_map), ("memory_budget", memory_budget)):
            if value is not None:
                raise InputError(
                    f"{name}= is for method 'sorted', not {method!r}: the other methods draw the panel's "
                    "own views by a rig"
                )
        if rig is None:
            raise InputError(f"method {method!r} needs a rig (Rig.frame makes one)")
    if memory_budget is not None and views == "continuous":
        raise InputError(
            "memory_budget goes with integer views: cameras for all distinct places within a lens have no "
            "bound; use method direct, which takes little memory, or integer views"
        )


def _tensors(gaussians: Gaussians) -> list[Tensor]:
    return [gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, gaussians.sh]


def background_tensor(background: Colour, like: Tensor) -> Tensor:
    """A background as a tensor [..., 3] of the dtype and on the device of `like`. Raises InputError."""
    if isinstance(background, (tuple, list)) and all(isinstance(c, (int, float)) for c in background):
        colour = _constant_background(tuple(background), like.dtype, like.device)
        if like.is_cuda and torch.cuda.is_current_stream_capturing():
            _of_graphs[colour.data_ptr()] = colour  # a graph of the user's keeps the address alone
        return colour
    return _checked_background(background, like.dtype, like.device)


_of_graphs: dict[int, Tensor] = {}


@lru_cache(maxsize=64)
def _constant_background(background: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Made once: copying it to a device would wait for the device every time."""
    with torch.inference_mode(False):  # it may be part of a graph of gradients later
        return _checked_background(background, dtype, device)


def _checked_background(background: Colour, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A tensor on a GPU is taken as it is: looking for NaN there would wait for it.

    Tensors and arrays may leave 0..1, for optimizers do; plain numbers that do are mistakes.
    """
    plain = not isinstance(background, (Tensor, np.ndarray))
    if not plain:
        background = dense_tensor("background", background)
    there = isinstance(background, Tensor) and background.is_cuda
    try:
        colour = torch.as_tensor(background, dtype=dtype, device=device)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise InputError(
            f"background must be three finite numbers R, G, B in 0..1, got {type(background).__name__}"
        ) from None
    if colour.dim() == 0 or colour.shape[-1] != 3 or not (there or bool(torch.isfinite(colour).all())):
        raise InputError(f"background must be three finite numbers R, G, B in 0..1, got {shown(background)}")
    if plain and not bool(((colour >= 0) & (colour <= 1)).all()):
        raise InputError(
            f"background must be three numbers R, G, B in 0..1, got {shown(background)}; divide bytes by 255"
        )
    return colour


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
