"""Checks of the arguments of `encode` and of an Encoder."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lightfield_gs.base.checks import expect, real_number, whole_number
from lightfield_gs.base.errors import InputError
from lightfield_gs.base.options import METHODS, ONLY_FOR, OUTPUTS, VIEWS, Method, Output, Views
from lightfield_gs.panels.panel import MAX_VIEWS, Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.rasterizer.operators import refuse_tangents
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians, check_values

DTYPES: dict[Output, torch.dtype] = {name: getattr(torch, name) for name in OUTPUTS}
MOST_THREADS = 1024
_MOST_BYTES = 1 << 62
_BY_A_RIG = ": the other methods draw the panel's own views by a rig"
_WHY_NOT = {"cameras": _BY_A_RIG, "view_map": _BY_A_RIG, "memory_budget": _BY_A_RIG, "out": ""}


def check_options(method: str, views: str, output: str) -> None:
    """Raise InputError for a method, views or output that `encode` does not know."""
    for name, value in (("method", method), ("views", views), ("output", output)):
        expect(name, value, str)
    if method not in METHODS or views not in VIEWS or output not in OUTPUTS:
        raise InputError(
            f"encode takes method {METHODS}, views {VIEWS} and output {OUTPUTS}, got {method!r}, "
            f"{views!r} and {output!r}"
        )


def wants_gradients(gaussians: Gaussians, background: Any, output: Output, cameras: Cameras | None = None) -> bool:
    """Return whether the image carries a graph: an argument asks for a gradient, and the output is not bytes.

    Raises InputError where one is a dual number of forward mode, whose tangent would be lost.
    """
    tensors = [*gaussians.fields().values(), background]
    if cameras is not None:
        tensors += [cameras.world_to_camera, cameras.intrinsics(), cameras.limits()]
    refuse_tangents(*tensors)
    asked = any(isinstance(t, Tensor) and t.requires_grad for t in tensors)
    return torch.is_grad_enabled() and output != "uint8" and asked


def refuse_with_gradients(**given: bool) -> None:
    """Raise InputError for the first of these arguments that was given although gradients are wanted."""
    for name in (name for name, is_given in given.items() if is_given):
        raise InputError(f"{name}= is for images without gradients: use torch.no_grad(), or leave it out")


def refuse_gradients(what: str) -> None:
    """Raise InputError for `what`, whose images carry no graph, where gradients are wanted."""
    raise InputError(
        f"{what} has no gradients, and an argument requires one: use encode(method='direct') or 'classic', or "
        "torch.no_grad()"
    )


def check_types(
    gaussians: Gaussians, panel: Panel, rig: Rig | None, cameras: Cameras | None, stats: Any, antialiased: bool
) -> None:
    """Raise InputError for arguments of types that `encode` does not take, and for Gaussians that cannot be drawn."""
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
    if gaussians.is_batched:
        raise InputError(f"encode takes one scene, means [N, 3], got {list(gaussians.means.shape)}")
    if not (gaussians.means.is_cuda and torch.cuda.is_current_stream_capturing()):
        check_values(gaussians)  # looks at values, which waits for the device: a stream that captures must not


def check_together(
    method: Method,
    views: Views,
    output: Output,
    rig: Rig | None,
    quality: Quality,
    threads: int | None,
    memory_budget: int | None,
    **given: Any,
) -> tuple[int | None, int | None]:
    """Return threads and memory_budget as whole numbers.

    Raises InputError where they are out of their ranges, and where arguments of one method meet another.
    given: the other arguments that one method alone takes (base/options.py).
    """
    if threads is not None:
        threads = whole_number("threads", threads, 1, MOST_THREADS)
    if memory_budget is not None:
        memory_budget = whole_number("memory_budget (bytes)", memory_budget, 1, _MOST_BYTES)
    for name, value in {"memory_budget": memory_budget, **given}.items():
        if value is not None and method != (only := ONLY_FOR[name]):
            raise InputError(f"{name}= is for method {only!r}, not {method!r}{_WHY_NOT[name]}")
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
    return threads, memory_budget


def check_view_filter(view_filter: Any, cameras: Cameras | None = None) -> float:
    """Return encode's view_filter as a float. Raises InputError out of its range, or where cameras= replace the rig."""
    view_filter = real_number("view_filter (views)", view_filter, 0.0, MAX_VIEWS)
    if view_filter > 0 and cameras is not None:
        raise InputError("view_filter= is for the views of a rig, and cameras= take its place: leave out one of them")
    return view_filter


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
