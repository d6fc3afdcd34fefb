"""A scene to the sub-pixel-encoded image of a panel, and the checks of the arguments."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lightfield_gs.base.arrays import Colour, background_tensor, for_graphs, is_eager, to_bytes
from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import METHODS, ONLY_FOR, OUTPUTS, VIEWS, Method, Output, QualityName, Views
from lightfield_gs.encoding.classic import classic_with_gradients, encode_classic
from lightfield_gs.encoding.compiled import encode_in_graph
from lightfield_gs.encoding.sorted import cameras_and_plan, encode_sorted
from lightfield_gs.encoding.sorted_plan import SortedPlan
from lightfield_gs.panels.optics import LENS, Optics
from lightfield_gs.panels.panel import MAX_VIEWS, Panel
from lightfield_gs.panels.rig import Rig, lenticular_camera, view_aperture
from lightfield_gs.rasterizer.direct import DirectRender, render_direct
from lightfield_gs.rasterizer.direct_optics import render_with_optics
from lightfield_gs.rasterizer.lenticular_camera import PINHOLE
from lightfield_gs.rasterizer.operators import refuse_tangents
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.rasterizer.stats import Stats, count_culled
from lightfield_gs.scene.cameras import Cameras, recentre
from lightfield_gs.scene.gaussians import Gaussians, check_values
from lightfield_gs.webgpu.devices import adapter_index, check_on_cpu, draw_direct

DTYPES: dict[Output, torch.dtype] = {name: getattr(torch, name) for name in OUTPUTS}
MOST_THREADS = 1024
_MOST_BYTES = 1 << 62
_BY_A_RIG = ": the other methods draw the panel's own views by a rig"
_ON_WEBGPU = ": the other methods are drawn where the Gaussians are, on the CPU or on CUDA"
_WHY_NOT = {"cameras": _BY_A_RIG, "view_map": _BY_A_RIG, "memory_budget": _BY_A_RIG, "out": "", "device": _ON_WEBGPU}


@for_graphs
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
    device: str | None = None,
    optics: Optics | None = None,
) -> Tensor:
    """Draw the image [..., H, W, 3] of a scene for a panel. The camera of a view sees the sub-pixels of this view.

    Under torch.compile, torch.export and torch.func, and of meta tensors, "direct" draws alone, exactly, and values are
    not checked.

    Args:
        gaussians: one scene, [N, ...]; or B sets [B, N, ...], drawn one after another by the same panel and rig.
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
        device: of "direct": "webgpu" or "webgpu:N" draws by WebGPU on adapter N of `lightfield-gs info --devices`.
            Gaussians and image then lie on the CPU. Bytes are those of the CPU to 1/255. Of a quality it heeds
            opacity_cut, transmittance_stop, colour_error and contribution_cut; lattices and arithmetic stay exact. It
            draws neither gradients nor "float64". None: where the Gaussians are.
        optics: numbers of panel and rig as tensors, in place of theirs. Float outputs of "direct" are differentiable
            in them too. Those of the lens (line_number, slant_tan, phase, subpixel_cells) need views="continuous".
            Where a lens ends the view jumps, and no gradient tells of that.

    Returns:
        The image, of the type of `output`.

    Raises:
        InputError: an argument has a wrong type, shape or value, or belongs to another method.
    """
    if isinstance(gaussians, Gaussians) and gaussians.is_batched:
        return _encode_sets(
            gaussians,
            stats,
            out,
            panel=panel,
            rig=rig,
            method=method,
            views=views,
            cameras=cameras,
            view_map=view_map,
            memory_budget=memory_budget,
            background=background,
            output=output,
            quality=quality,
            threads=threads,
            antialiased=antialiased,
            view_filter=view_filter,
            device=device,
            optics=optics,
        )
    check_types(method, views, output, gaussians, panel, rig, cameras, stats, antialiased)
    expect("optics", optics, Optics, type(None))
    quality, view_filter, threads, memory_budget = check_together(
        method,
        views,
        output,
        rig,
        cameras,
        quality,
        view_filter,
        threads,
        memory_budget,
        view_map=view_map,
        out=out,
        device=device,
    )
    continuous, as_bytes = views == "continuous", output == "uint8"
    if optics is not None:
        panel, rig = optics.panel(panel), None if rig is None else optics.rig(rig)
    if out is not None:
        check_out(out, output, panel, gaussians.device)
    if device is not None:
        check_webgpu(device, output)
        check_on_cpu(device, gaussians)
    gaussians = gaussians.to(dtype=torch.float64 if output == "float64" else torch.float32)
    fields = gaussians.fields().values()
    colour = background_tensor(background, gaussians.means).reshape(-1)
    traced = not is_eager((*fields, colour))
    if traced:
        check_traced(method, optics)
    if wants_gradients(fields, colour, output, cameras, optics) or traced:
        if method == "sorted":
            refuse_gradients("method 'sorted'")
        refuse_with_gradients(
            quality=not quality.is_exact,
            threads=threads is not None,
            stats=stats is not None,
            out=out is not None,
            device=device is not None,
        )
        learned = [] if optics is None else [name for name, t in optics.given().items() if t.requires_grad]
        if optics is not None and learned:
            check_learned(learned, method, continuous)
        if method == "classic":
            refuse_with_gradients(view_filter=view_filter > 0)
            return classic_with_gradients(gaussians, panel, cast(Rig, rig), continuous, colour, antialiased)
        if torch.compiler.is_dynamo_compiling():
            lens = panel, cast(Rig, rig), continuous, view_filter
            image = encode_in_graph(tuple(fields), colour, *lens, antialiased)
            return to_bytes(image.detach().clone()) if as_bytes else image
        camera = lenticular_camera(panel, cast(Rig, rig), continuous, view_filter)
        if optics is not None and learned:
            numbers = optics.rig_numbers(panel, cast(Rig, rig), view_filter)
            return render_with_optics(list(fields), colour, camera, antialiased, numbers, optics.lens_numbers(panel))
        image = render_direct(*fields, colour, *camera.numbers(), antialiased)
        return to_bytes(image.detach().clone()) if as_bytes else image
    counters = Stats(device=gaussians.means.device if stats is not None else None)
    if method == "direct":
        camera = lenticular_camera(panel, cast(Rig, rig), continuous, view_filter)
        with torch.no_grad():
            with counters.stage("plan"):
                job = DirectRender(fields, colour, camera, antialiased)
            if device is None:
                image = job.draw(as_bytes, quality, counters, threads, out)
            else:
                image = draw_direct(device, job, as_bytes, quality, counters, out)
    elif method == "classic":
        aperture = view_aperture(panel, cast(Rig, rig), view_filter)
        options = DTYPES[output], threads, counters, antialiased, aperture
        image = encode_classic(gaussians, panel, cast(Rig, rig), continuous, colour, *options)
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
        count = len(gaussians.means)
        stats.update(counters.report(count, image.numel()))
        if method == "direct":
            drawn = count - stats["gaussians_culled"]
            culled = count_culled(gaussians, cast(Rig, rig).world_to_camera, drawn, counters.pruned)
            stats["skipped"] = {"gaussians": culled, **counters.skipped}
    return image


def _encode_sets(gaussians: Gaussians, stats: object, out: Tensor | None, **others: Any) -> Tensor:
    """Draw each of B sets of Gaussians, [B, H, W, 3]; others: arguments of encode."""
    gaussians.validate_layout()
    sets = len(gaussians.means)
    if stats is not None:
        raise InputError(f"stats= tells of one scene, and there are {sets} sets of Gaussians: leave it out")
    expect("out", out, Tensor, type(None))
    if sets == 0 or out is not None and (out.dim() != 4 or len(out) != sets):
        got = "0 sets of Gaussians" if out is None else f"{sets} sets of Gaussians and out {list(out.shape)}"
        raise InputError(f"gaussians: expected at least one set, and out [sets, H, W, 3] or none, got {got}")
    into = [None] * sets if out is None else out.unbind()
    images = []
    for row, image in enumerate(into):
        fields: dict[str, Any] = {name: tensor[row] for name, tensor in gaussians.fields().items()}
        images.append(encode(replace(gaussians, **fields), out=image, **others))
    return torch.stack(images) if out is None else out


def check_options(method: str, views: str, output: str) -> None:
    """Raise InputError for a method, views or output that `encode` does not know."""
    for name, value in (("method", method), ("views", views), ("output", output)):
        expect(name, value, str)
    if method not in METHODS or views not in VIEWS or output not in OUTPUTS:
        raise InputError(
            f"encode takes method {METHODS}, views {VIEWS} and output {OUTPUTS}, got {method!r}, "
            f"{views!r} and {output!r}"
        )


def check_types(
    method: str,
    views: str,
    output: str,
    gaussians: Gaussians,
    panel: Panel,
    rig: Rig | None,
    cameras: Cameras | None,
    stats: Any,
    antialiased: bool,
) -> None:
    """Raise InputError for names and types that `encode` does not take, and for Gaussians that cannot be drawn."""
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
    if torch.compiler.is_compiling() or not (gaussians.means.is_cuda and torch.cuda.is_current_stream_capturing()):
        check_values(gaussians)  # reads values, which waits for the device: forbidden in a stream that captures


def check_view_filter(view_filter: Any, cameras: Cameras | None = None) -> float:
    """Return encode's view_filter as a float. Raises InputError out of its range, or where cameras= replace the rig."""
    view_filter = real_number("view_filter (views)", view_filter, 0.0, MAX_VIEWS)
    if view_filter > 0 and cameras is not None:
        raise InputError("view_filter= is for the views of a rig, and cameras= take its place: leave out one of them")
    return view_filter


def check_together(
    method: Method,
    views: Views,
    output: Output,
    rig: Rig | None,
    cameras: Cameras | None,
    quality: QualityName | Quality,
    view_filter: float,
    threads: int | None,
    memory_budget: int | None,
    **given: Any,
) -> tuple[Quality, float, int | None, int | None]:
    """Return quality, view_filter, threads and memory_budget, checked.

    Raises InputError where they are out of their ranges, and where arguments of one method meet another.
    given: the other arguments, which only one method takes (base/options.py).
    """
    view_filter = check_view_filter(view_filter, cameras)
    quality = Quality.of(quality)
    if threads is not None:
        threads = whole_number("threads", threads, 1, MOST_THREADS)
    if memory_budget is not None:
        memory_budget = whole_number("memory_budget (bytes)", memory_budget, 1, _MOST_BYTES)
    for name, value in {"memory_budget": memory_budget, "cameras": cameras, **given}.items():
        if value is not None and method != (only := ONLY_FOR[name]):
            raise InputError(f"{name}= is for method {only!r}, not {method!r}{_WHY_NOT[name]}")
    if cameras is not None and cameras.model != "pinhole":
        raise InputError(f"cameras=: the views of a panel are by pinhole cameras, and these are {cameras.model}")
    if cameras is not None and cameras.rolling_shutter != "none":
        raise InputError("cameras=: the views of a panel are by cameras at rest, and these have a rolling shutter")
    if method != "sorted" and rig is None:
        raise InputError(f"method {method!r} needs a rig (Rig.frame makes one)")
    if memory_budget is not None and views == "continuous":
        raise InputError(
            "memory_budget goes with integer views: cameras for all distinct places within a lens have no "
            "bound; use method direct, which takes little memory, or integer views"
        )
    if not quality.is_exact and (method != ONLY_FOR["quality"] or output == "float64"):
        raise InputError(
            f"quality is for method 'direct' and output 'uint8' or 'float32', not {method!r} and "
            f"{output!r}: those are exact only"
        )
    return quality, view_filter, threads, memory_budget


def check_out(out: Tensor, output: Output, panel: Panel, device: torch.device) -> None:
    """Raise InputError where `out` is no tensor that an image of the panel can be drawn into."""
    expect("out", out, Tensor)
    expected = (panel.height_px, panel.width_px, 3), DTYPES[output], device
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


def check_webgpu(device: str, output: Output) -> None:
    """Raise InputError where WebGPU cannot draw such an image, or `device` is no name of one of its adapters."""
    expect("device", device, str)
    adapter_index(device)
    if output == "float64":
        raise InputError(f"device={device!r} draws output 'uint8' or 'float32': 'float64' needs device=None")


def check_traced(method: Method, optics: Optics | None) -> None:
    """Raise InputError for arguments that need values, where values cannot be read (arrays.is_eager)."""
    if method != "direct":
        raise InputError(
            f"method {method!r} reads values, and there are none under torch.compile, torch.export and torch.func: use "
            "method 'direct'"
        )
    if optics is not None:
        raise InputError(
            "optics: their values are read, and there are none under torch.compile, torch.export and torch.func: leave "
            "them out, or call encode outside"
        )


def check_learned(names: list[str], method: Method, continuous: bool) -> None:
    """Raise InputError where these tensors of Optics ask for gradients that there are none of."""
    if method != "direct":
        raise InputError(
            f"optics: method {method!r} has no gradients to {', '.join(names)}: use method 'direct', or detach() them"
        )
    lens = [name for name in names if name in LENS]
    if lens and not continuous:
        raise InputError(
            f"optics: with integer views sub-pixels jump from camera to camera, so that {', '.join(lens)} have no "
            "gradients: use views='continuous', or detach() them"
        )


def wants_gradients(
    fields: Iterable[Tensor],
    background: Any,
    output: Output,
    cameras: Cameras | None = None,
    optics: Optics | None = None,
) -> bool:
    """Return whether the image carries a graph: an argument asks for a gradient, and the output is not bytes.

    Raises InputError where one is a dual number of forward mode, whose tangent would be lost.
    """
    tensors = [*fields, background]
    if cameras is not None:
        tensors += [cameras.world_to_camera, cameras.intrinsics(), cameras.limits()]
    if optics is not None:
        tensors += optics.given().values()
    refuse_tangents(*tensors)
    asked = any(isinstance(t, Tensor) and t.requires_grad for t in tensors)
    return torch.is_grad_enabled() and output != "uint8" and asked


def refuse_gradients(what: str) -> None:
    """Raise InputError for `what`, whose images carry no graph, where gradients are wanted."""
    raise InputError(
        f"{what} has no gradients, and an argument requires one: use encode(method='direct') or 'classic', or "
        "torch.no_grad()"
    )


def refuse_with_gradients(**given: bool) -> None:
    """Raise InputError for the first of these arguments that was given although gradients are wanted."""
    for name in (name for name, is_given in given.items() if is_given):
        raise InputError(
            f"{name}= is for images without gradients that no torch.compile or torch.func traces: use torch.no_grad() "
            "outside of these, or leave it out"
        )
