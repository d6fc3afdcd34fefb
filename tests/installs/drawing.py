"""Cases: images and their gradients, frame after frame, pruning."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from installs.record import case, fields_of
from installs.scenes import PANELS, arc, panel, rig, scene, view_map
from lightfield_gs import Encoder, Gaussians, Quality, Rig, SortedPlan, encode, interlace, prune, render

Found = Iterator[tuple[str, Any]]
_COLOUR = (0.1, 0.4, 0.8)


def _precisions(device: torch.device) -> list[torch.dtype]:
    return [torch.float32] if device.type == "cuda" else [torch.float32, torch.float64]


def _outputs(device: torch.device) -> list[str]:
    return ["uint8", "float32"] if device.type == "cuda" else ["uint8", "float32", "float64"]


def _known(stats: dict[str, Any]) -> dict[str, Any]:
    """Return the stats of encode; of times and sizes of memory only the keys."""
    kept = {key: value for key, value in stats.items() if key != "stages_ms" and "bytes" not in key}
    return {"keys": sorted(stats), "stages": sorted(stats["stages_ms"]), **kept}


def _rendered(*arguments: Any, **options: Any) -> list[Tensor]:
    """The images that were asked for; installs of old return a tensor where that is the image alone."""
    images = render(*arguments, **options)
    return [images] if isinstance(images, Tensor) else [image for image in images if image is not None]


@case
def render_images(device: torch.device) -> Found:
    cameras = arc(3, 90, 61, device)
    for dtype, degree, antialiased in product(_precisions(device), range(4), (False, True)):
        gaussians = scene(400, degree, degree, device, dtype)
        words = f"{dtype}, degree {degree}{', antialiased' if antialiased else ''}"
        parts = _rendered(gaussians, cameras, background=_COLOUR, alpha=True, depth=True, antialiased=antialiased)
        yield from zip((f"{words}: {name}" for name in ("image", "alpha", "depth")), parts)
    for dtype in _precisions(device):
        gaussians = scene(150, 2, 7, device, dtype, batch=2)
        colour = torch.tensor([[0.2, 0.5, 0.1]], device=device)
        yield f"batch, {dtype}", _rendered(gaussians, cameras, background=colour)[0]
    yield "one pixel", _rendered(scene(50, device=device), arc(1, 1, 1, device), background=(0, 0, 0))[0]
    yield "no Gaussians", _rendered(scene(0, device=device), cameras)[0]
    yield "huge and tiny", _rendered(scene(60, 3, 1, device, size=2.0), cameras, antialiased=True)[0]


@case
def encode_direct(device: torch.device) -> Found:
    gaussians = scene(400, 2, 1, device)
    for name, views in product(PANELS, ("integer", "continuous")):
        of, stats = panel(name), {}
        image = encode(gaussians, of, rig(of), views=views, background=_COLOUR, output="float32", stats=stats)
        yield f"{name}, {views}", image
        yield f"{name}, {views}: stats", _known(stats)
    of = panel()
    for output, degree, antialiased in product(_outputs(device), range(4), (False, True)):
        image = encode(
            scene(300, degree, 3, device), of, rig(of), output=output, antialiased=antialiased, background=_COLOUR
        )
        yield f"{output}, degree {degree}{', antialiased' if antialiased else ''}", image
    yield "over an image", encode(gaussians, of, rig(of), out=torch.zeros(84, 150, 3, dtype=torch.uint8, device=device))
    yield "three threads", encode(gaussians, of, rig(of), threads=3)
    yield "no Gaussians", encode(scene(0, device=device), of, rig(of))


@case
def encode_qualities(device: torch.device) -> Found:
    knobs = (
        dict(opacity_cut=0.02),
        dict(transmittance_stop=0.02),
        dict(colour_error=0.02),
        dict(lattice_error=0.01),
        dict(contribution_cut=0.01),
        dict(evaluation_error=0.02),
    )
    gaussians = scene(2000, 2, 1, device, size=0.03)
    for name, antialiased in product(("stripes", "wide lenses", "cells"), (False, True)):
        of = panel(name, width_px=320, height_px=192)
        for quality in ("exact", "high", "fast", "draft"):
            stats: dict[str, Any] = {}
            image = encode(gaussians, of, rig(of), quality=quality, antialiased=antialiased, stats=stats)
            words = f"{name}, {quality}{', antialiased' if antialiased else ''}"
            yield words, image
            yield f"{words}: stats", _known(stats)
    of = panel(width_px=320, height_px=192)
    for knob in knobs:
        yield str(knob), encode(gaussians, of, rig(of), quality=Quality(**knob), output="float32", views="continuous")


@case
def encode_other_methods(device: torch.device) -> Found:
    gaussians = scene(300, 2, 2, device)
    for method, name, views in product(("sorted", "classic"), PANELS, ("integer", "continuous")):
        size = (70, 40) if views == "integer" else (18, 9)  # there every sub-pixel has a view of its own
        of, stats = panel(name, views=9, width_px=size[0], height_px=size[1]), {}
        yield f"{method}, {name}, {views}", encode(gaussians, of, rig(of), method, views=views, stats=stats)
        yield f"{method}, {name}, {views}: stats", _known(stats)
    of = panel()
    cameras, table = arc(7, of.width_px, of.height_px), view_map(of, 7)
    own = dict(cameras=cameras, view_map=table)
    for output, antialiased in product(_outputs(device), (False, True)):
        options = dict(output=output, antialiased=antialiased, background=_COLOUR)
        yield f"{options}", encode(gaussians, of, None, "sorted", **own, **options)
    stats = {}
    yield "budget", encode(gaussians, of, None, "sorted", **own, memory_budget=2_000_000, stats=stats)
    yield "budget: stats", _known(stats)
    plan = SortedPlan(of, table, 7, device)
    yield "plan", encode(gaussians, of, None, "sorted", cameras=cameras, view_map=plan)
    yield "plan: lists", [plan.count, plan.bytes(), plan.shown.tolist(), plan.hidden]
    yield "interlace", interlace(_rendered(gaussians, rig(of).cameras(of))[0], of)


@case
def gradients_of_render(device: torch.device) -> Found:
    for dtype, antialiased in product(_precisions(device), (False, True)):
        gaussians = scene(200, 2, 4, device, dtype)
        cameras = arc(2, 70, 51, device, dtype)
        cameras.world_to_camera.requires_grad_()
        colour = torch.tensor([[0.2, 0.5, 0.1], [0.9, 0.1, 0.4]], device=device, dtype=dtype)

        def images(gaussians=gaussians, cameras=cameras, colour=colour, antialiased=antialiased) -> Tensor:
            parts = _rendered(gaussians, cameras, background=colour, alpha=True, depth=True, antialiased=antialiased)
            return torch.cat([part.reshape(-1) for part in parts])

        words = f"{dtype}{', antialiased' if antialiased else ''}"
        yield from _gradients(words, gaussians, colour, images)
        yield f"{words}: camera", cameras.world_to_camera.grad


@case
def gradients_of_encode(device: torch.device) -> Found:
    for name, dtype, antialiased in product(("stripes", "wide lenses", "cells"), _precisions(device), (False, True)):
        of, gaussians = panel(name), scene(200, 2, 5, device, dtype)
        colour = torch.tensor([0.2, 0.5, 0.1], device=device, dtype=dtype)

        def image(gaussians=gaussians, of=of, colour=colour, dtype=dtype, antialiased=antialiased) -> Tensor:
            output = str(dtype).removeprefix("torch.")
            options = dict(background=colour, output=output, antialiased=antialiased, views="continuous")
            return encode(gaussians, of, rig(of), **options).reshape(-1)

        yield from _gradients(f"{name}, {dtype}{', antialiased' if antialiased else ''}", gaussians, colour, image)


def _gradients(words: str, gaussians: Gaussians, colour: Tensor, draw: Callable[[], Tensor]) -> Found:
    """Return the result of `draw`, and gradients of its sum with weights that differ from pixel to pixel."""
    leaves = {**gaussians.fields(), "background": colour}
    for leaf in leaves.values():
        leaf.requires_grad_()
    drawn = draw()
    weights = np.random.default_rng(1).normal(size=drawn.shape)
    (drawn * torch.from_numpy(weights).to(drawn)).sum().backward()
    yield f"{words}: drawn", drawn
    yield from ((f"{words}: by {name}", leaf.grad) for name, leaf in leaves.items())


@case
def operators(device: torch.device) -> Found:
    """Their schemas, and a call as other programs make it."""
    encode(scene(1, device=device), panel(), rig(panel()))  # now all are registered
    schemas = {str(schema) for schema in torch._C._jit_get_all_schemas() if schema.name.startswith("lightfield_gs::")}
    yield "schemas", sorted(schemas)
    cameras, gaussians = arc(2, 50, 40, device, torch.float32), scene(100, 1, 8, device)
    tensors = [field.unsqueeze(0) for field in gaussians.fields().values()]
    views = [t.unsqueeze(0) for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())]
    colour = torch.full((1, 2, 3), 0.3, device=device)
    known = torch.ops.lightfield_gs
    call = known.render_images if hasattr(known, "render_images") else known.render_dense  # of installs of old
    yield from zip(("image", "alpha", "depth"), call(*tensors, colour, *views, 50, 40, False))


@case
def encoder_frames(device: torch.device) -> Found:
    of = panel("stripes", width_px=200, height_px=120)
    for output, quality, antialiased in product(_outputs(device), ("exact", "fast"), (False, True)):
        if output == "float64" and quality != "exact":
            continue
        encoder = Encoder(of, rig(of), output=output, quality=quality, antialiased=antialiased)
        yield from _frames(f"{output}, {quality}{', antialiased' if antialiased else ''}", encoder, device)
    yield from _frames("cells", Encoder(panel("cells"), rig(panel("cells")), views="continuous"), device)
    yield from _frames("versioned", Encoder(of, rig(of), versioned=True), device)


def _frames(words: str, encoder: Encoder, device: torch.device) -> Found:
    """Frames of which each changes something else. On CUDA all are drawn into the same tensor."""
    gaussians, of = scene(500, 2, 6, device), encoder.panel
    yield f"{words}: first", encoder(gaussians).clone()
    yield f"{words}: nothing changed", encoder(gaussians).clone()
    encoder.rig = rig(of, zero_depth=2.1)
    yield f"{words}: zero plane", encoder(gaussians).clone()
    yield f"{words}: same rig", encoder(gaussians).clone()
    encoder.rig = rig(of, 0.2)
    yield f"{words}: pose", encoder(gaussians).clone()
    gaussians.sh.mul_(0.9)
    yield f"{words}: colours", encoder(gaussians).clone()
    encoder.background = _COLOUR
    yield f"{words}: background", encoder(gaussians).clone()
    gaussians.means.add_(0.01)
    yield f"{words}: places", encoder(gaussians).clone()
    yield f"{words}: another scene", encoder(scene(700, 1, 9, device)).clone()
    encoder.forget()
    yield f"{words}: forgotten", encoder(gaussians).clone()
    yield f"{words}: stats", {"frames": encoder.stats["frames"], "reused": sorted(encoder.stats["reused"])}


@case
def pruning(device: torch.device) -> Found:
    for name, antialiased in product(("stripes", "cells"), (False, True)):
        of = panel(name)
        kept = prune(scene(800, 1, 3, device, size=0.03), of, rig(of), 0.01, antialiased)
        yield from fields_of(f"{name}{', antialiased' if antialiased else ''}", kept)


@case
def framing(device: torch.device) -> Found:
    gaussians = scene(500, 0, 2, device)
    for name, up in product(("stripes", "inverted"), ("-y", "z", "x")):
        notes: list[str] = []
        yield f"{name}, {up}", Rig.frame(gaussians, panel(name), up=up, notes=notes).to_dict()
        yield f"{name}, {up}: notes", notes
    yield "from a camera", Rig.frame(gaussians, panel(), np.eye(4)).to_dict()
    yield "portrait", Rig.frame(gaussians, panel(width_px=60, height_px=140)).to_dict()
