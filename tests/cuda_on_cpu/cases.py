"""Scenes and frames for the CPU's stages and the CUDA stages compiled for the CPU."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from rasterizer_cases import CELLS, MIRRORED
from torch import Tensor

from lightfield_gs import Gaussians, Optics, Panel, Quality, Rig, encode, render
from lightfield_gs.base.options import DEFAULT_PANEL
from lightfield_gs.bench.scenes import benchmark_rig, cloud, sheet, with_harmonics

LENS = dict(width_px=61, height_px=37, views=96, line_number=9.848282191911, slant_tan=1 / 6, phase=-2161.2044846576)
PANELS = {
    "default": {},
    "leaning the other way, BGR": dict(slant_tan=-0.18, subpixel_order="BGR", line_number=16.013),
    "inverted": dict(invert_views=True),
    "narrow lenses": dict(views=9, line_number=2.6),
    "one view": dict(views=1),
    "narrow cone": dict(cone_deg=4.0),
    "cells": dict(line_number=19.17, slant_tan=0.1455, subpixel_cells=CELLS, cell_pattern=2),
    "cells that exchange colours": dict(subpixel_cells=MIRRORED, cell_pattern=1),
}
BACKGROUND = (0.1, 0.6, 0.3)
PRUNING = Quality(contribution_cut=0.6, opacity_cut=0.02)


def frames_of(kernel: str) -> list[tuple[str, int, str]]:
    """Panel, SH degree and views of every frame; fewer of the kernel with tensor cores, which take seconds here."""
    names = [*list(PANELS)[:2], "cells"] if kernel == "lens-column" else PANELS
    frames = [(name, degree, views) for name in names for degree, views in ((0, "integer"), (3, "continuous"))]
    return [*frames, ("default", 0, "continuous")]  # with harmonics or without, lists of more than fits at a time


# What a block may take on cards whose multiprocessors have 100 KB; panels, SH degrees and views of frames drawn so
SMALL_SHARED_MEMORY = 99 * 1024
COMPACT_FRAMES = [
    ("default", 0, "continuous"),
    ("leaning the other way, BGR", 3, "continuous"),
    ("cells", 3, "integer"),
]


# Gaussians, SH degree, order of colours and intersections of frames whose memory is counted
_M = 10**6
WORK_BUFFERS = [(0, 0, 0, 0), (_M, 0, 0, 0), (_M, 0, 0, 26 * _M), (0, 3, 8, 26 * _M), (_M, 3, 8, 26 * _M)]


def scene_of(degree: int) -> Gaussians:
    return with_harmonics(cloud(900, 11), degree) if degree else sheet(24, 11)


def rig_of(panel: Panel) -> Rig:
    return Rig(np.eye(4), (panel.width_px,) * 2, (0.52 * panel.width_px, 0.47 * panel.height_px), 2.0)


def panel_of(name: str) -> Panel:
    return Panel(**{**LENS, **PANELS[name]})


# Kernels, and cones (degrees) in which a colour is nearly a parabola
PARABOLAS = [("pixel", 1.0), ("pixel-small", 1.0), ("pixel-quadratic", 2.0), ("lens-column", 2.0)]

# Kernel that draws what is not smooth, quality, views, panel: see lattice_frame
LATTICE_FRAMES = [
    ("pixel", "high", "integer", dict(cone_deg=1.0)),
    ("pixel-quadratic", "fast", "continuous", dict(subpixel_order="BGR", slant_tan=-0.18)),
    ("lens-column", "high", "continuous", dict(subpixel_order="BGR", slant_tan=-0.18, line_number=16.013)),
    ("lens-column", "fast", "integer", dict(invert_views=True)),
    ("pixel", "high", "integer", dict(line_number=61.7)),
    ("pixel", "fast", "integer", dict(line_number=0.7, cone_deg=4.0)),
]

# Panels of whose images four bytes may be stored at a time
WORDS = [dict(width_px=208), dict(width_px=208, subpixel_order="BGR")]


def lattice_frame(changes: dict[str, Any], degree: int) -> tuple[Gaussians, Panel, Rig]:
    """A piece of an 8K panel, odd in width and height, and a sheet before it, smooth but for small Gaussians on the
    right."""
    panel = Panel(**{**LENS, "width_px": 205, "height_px": 71, "cone_deg": 12.0, **changes})
    rig = replace(
        benchmark_rig("sheet:1", None, replace(panel, width_px=7680, height_px=4320), panel.cone_deg),
        principal_point_px=(102.5, 35.5),
    )
    smooth, random, count = sheet(128), torch.Generator().manual_seed(2), 60
    where = torch.rand(count, 3, generator=random) * torch.tensor([0.012, 0.018, 0.02])
    rough = Gaussians(
        where + torch.tensor([0.014, -0.009, 1.95]),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        torch.full((count, 3), 4e-4),
        torch.full((count,), 0.9),
        3 * torch.rand(count, 1, 3, generator=random) - 1.5,
    )
    near = (smooth.means[:, :2].abs() < 0.3).all(1)
    parts = [{name: field[near] for name, field in smooth.fields().items()}, rough.fields()]
    scene = Gaussians(*(torch.cat([part[name] for part in parts]) for name in parts[0]))
    return (with_harmonics(scene, degree) if degree else scene), panel, rig


def half_empty(changes: dict[str, Any]) -> tuple[Gaussians, Panel, Rig]:
    """A frame with a lattice, and nothing before its right half."""
    scene, panel, rig = lattice_frame(changes, 0)
    x, z = scene.means[:, 0], scene.means[:, 2]
    shown = rig.focal_px[0] * (x + 4 * scene.scales.max(1).values) / z + rig.principal_point_px[0] < 100
    return Gaussians(*(field[shown] for field in scene.fields().values())), panel, rig


def harmonic_piece() -> tuple[Gaussians, Panel, Rig]:
    """A piece of the benchmark's frame of a cloud with harmonics in a wide cone, and what of the cloud may touch it."""
    scene, left, top = with_harmonics(cloud(1 << 18), 3), 5119, 3065
    whole = Panel(7680, 3840, 96, 16.013, math.tan(0.18), cone_deg=53.0)
    panel, rig = replace(whole, width_px=48, height_px=32), benchmark_rig("cloud:262144", None, whole, "wide")
    rig = replace(rig, principal_point_px=(whole.width_px / 2 - left, whole.height_px / 2 - top))
    x, y, z = scene.means.unbind(1)
    reach = 4 + 6.4 * whole.width_px * scene.scales.max(1).values / z
    half = rig.zero_depth * math.tan(math.radians(rig.cone_deg / 2))
    swing = whole.width_px * half * (1 / z - 1 / rig.zero_depth).abs()
    u, v = (f * along / z + centre for f, along, centre in zip(rig.focal_px, (x, y), rig.principal_point_px))
    near = (u + swing + reach > 0) & (u - swing - reach < panel.width_px)
    near &= (v + reach > 0) & (v - reach < panel.height_px)
    return Gaussians(*(field[near] for field in scene.fields().values())), panel, rig


# Kernels that go on behind where a sample ends, and panels on which few splats are for their exact formulas
OPAQUE_FRAMES = [("pixel", "narrow cone"), ("pixel-small", "narrow cone"), ("lens-column", "default")]


def opaque(name: str) -> tuple[Gaussians, Panel, Rig]:
    """So many Gaussians of middling opacity over the whole panel that every sample ends before the last."""
    panel, scene = panel_of(name), cloud(900, 11)
    scene = replace(
        scene,
        scales=scene.scales.clamp_min(0.15),
        opacities=0.1 + 0.3 * scene.opacities,
        sh=torch.full_like(scene.sh, 1.5),
    )
    return scene, panel, rig_of(panel)


def wide_frames() -> list[tuple[Gaussians, Panel, Rig]]:
    """Scenes before two whole panels: the default panel, and a panel with a cone of 53 degrees.

    The last scene of each has thin discs, whose S varies much.
    """
    panels = [Panel.load(DEFAULT_PANEL), Panel(7680, 3840, 96, 16.013, math.tan(0.18), cone_deg=53.0)]
    flat = cloud(8192)
    flat.scales[:, 2] = 1e-4
    return [
        (scene, panel, benchmark_rig("cloud:8192", scene, panel, panel.cone_deg))
        for panel in panels
        for scene in (sheet(96), cloud(8192), flat)
    ]


# Kernel (None: the frame chooses), views, panel
WIDEST = [
    (*how, changes)
    for how in (("lens-column", "integer"), ("lens-column", "continuous"), (None, "integer"))
    for changes in (dict(cone_deg=150.0), dict(cone_deg=179.9), dict(views=2))
]


def widest(changes: dict[str, Any]) -> tuple[Gaussians, Panel, Rig]:
    """Gaussians whose S varies by orders of magnitude along a rig, or much from one view to the next."""
    panel, scene = replace(panel_of("default"), **changes), sheet(12, 11)
    return scene, panel, rig_of(panel)


def blades() -> Gaussians:
    """Lines thousands of pixels long, at every angle."""
    scene = cloud(30, 11)
    angle = torch.linspace(0, math.pi, scene.count)
    turns = torch.stack([(angle / 2).cos(), 0 * angle, 0 * angle, (angle / 2).sin()], 1)
    lines = torch.tensor([100.0, 1e-6, 1e-6]).expand(scene.count, 3).contiguous()
    return replace(scene, scales=lines, quaternions=turns)


def short_quaternions() -> Gaussians:
    """Gradients of a camera or two are beyond the largest float where those of three are not."""
    scene = cloud(30, 11)
    return replace(scene, quaternions=3.3e-39 * scene.quaternions)


HARD_GRADIENTS = [(scene, sensor) for scene in (blades, short_quaternions) for sensor in ("direct", "images")]


CURVED = ("orthographic", "fisheye", "equirectangular", "rolling")  # cameras that are no pinholes, or roll


def gradients(
    scene: Gaussians, sensor: str, dtype: torch.dtype, antialiased: bool = False, view_filter: float = 0.0
) -> dict[str, Tensor]:
    """Return the gradients of a loss on a light-field image (direct) or on ordinary images, and the image.

    sensor: direct, images, or one of CURVED.
    """
    panel = Panel(**{**LENS, "width_px": 16, "height_px": 12, "cone_deg": 12.0})
    scene, rig = scene.to(dtype=dtype), rig_of(panel)
    leaves = {name: field.clone().requires_grad_() for name, field in scene.fields().items()}
    given = Gaussians(**leaves)
    if sensor == "direct":
        output = str(dtype).removeprefix("torch.")
        options = dict(antialiased=antialiased, view_filter=view_filter)
        image = encode(given, panel, rig, background=BACKGROUND, output=output, **options)
    else:
        cameras = rig.cameras(panel, [23, 11, 0]).to(dtype=dtype)
        if sensor != "images":
            focal = cameras.focal_px / (rig.zero_depth if sensor == "orthographic" else 1)
            model = "pinhole" if sensor == "rolling" else sensor
            cameras = replace(cameras, model=model, focal_px=focal, jacobian_limits=None)
        if sensor == "rolling":
            turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.05, 0.03], [0.05, 0, -0.04], [-0.03, 0.04, 0]]))
            first = cameras.world_to_camera.clone().requires_grad_()
            last = torch.block_diag(turn, torch.ones(1)).to(first) @ first.detach().roll(1, 0)
            last.requires_grad_()
            leaves |= {"first": first, "last": last}
            motion = {"world_to_camera": first, "world_to_camera_end": last}
            cameras = replace(cameras, rolling_shutter="top_to_bottom", **motion)
        if sensor in CURVED or antialiased:
            names = "focal_px", "principal_point_px"
            optics = {name: getattr(cameras, name).clone().requires_grad_() for name in names}
            cameras, leaves = replace(cameras, **optics), leaves | optics
        image = render(given, cameras, background=BACKGROUND, antialiased=antialiased).image
    loss = (image * torch.linspace(-1, 2, image.numel()).to(image).view_as(image)).sum()
    return {**dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())))), "image": image.detach()}


# Panel (None: half of the colours are on circles), SH degree, and options of encode; of gradients to optics
OPTICS: list[tuple[str | None, int, dict[str, Any]]] = [
    ("default", 0, {}),
    ("cells", 3, {}),
    ("inverted", 1, {"view_filter": 3.0}),
    ("leaning the other way, BGR", 1, {"antialiased": True}),
    (None, 3, {}),
]


def optics_gradients(
    name: str | None, degree: int, options: dict[str, Any], dtype: torch.dtype, device: str = "cpu"
) -> dict[str, Tensor]:
    """Return the gradients of a loss on a light-field image, and the image; of a panel of several tiles."""
    scene, panel, rig = near(NEAR[1])
    scene.scales[:, 0] *= 2  # of round ones quaternions have no gradients
    if name is not None:
        scene, panel = scene_of(degree), panel_of(name)
        turn = torch.linalg.matrix_exp(torch.tensor([[0, -0.05, 0.03], [0.05, 0, -0.04], [-0.03, 0.04, 0]]).double())
        rig = replace(rig_of(panel), world_to_camera=torch.block_diag(turn, torch.ones(1)).numpy())
    scene.sh[:, 0] += 3  # where colours are clamped at zero, gradients jump
    numbers = {n: t.detach().to(device).requires_grad_() for n, t in Optics.of(panel, rig).given().items()}
    leaves = {n: t.to(device=device, dtype=dtype).requires_grad_() for n, t in scene.fields().items()}
    options = dict(views="continuous", background=BACKGROUND, output=str(dtype).removeprefix("torch."), **options)
    image = encode(Gaussians(**leaves), panel, rig, optics=Optics(**numbers), **options)
    leaves |= numbers
    loss = (image * torch.linspace(-1, 2, image.numel()).to(image).view_as(image)).sum()
    return {**dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())))), "image": image.detach()}


# Of anti-aliased scenes: kernel (None: the frame chooses), panel, SH degree, views and quality
ANTIALIASED = [
    ("pixel-quadratic", "default", 0, "integer", "exact"),
    (None, "narrow cone", 1, "integer", "draft"),
    ("pixel-quadratic-small", "leaning the other way, BGR", 3, "continuous", "exact"),
    ("lens-column", "default", 0, "integer", "exact"),
    ("lens-column", "default", 3, "continuous", "exact"),
    ("lens-column", "leaning the other way, BGR", 1, "continuous", "exact"),
]
COMPACT_ANTIALIASED = ANTIALIASED[4]
# Of the same, with a view filter of this many views and without anti-aliasing
VIEW_FILTER = 12.0
FILTERED = [ANTIALIASED[0], ANTIALIASED[2], ANTIALIASED[4]]


NEAR = (0.05, 0.2)  # depths of the nearest, by that of the zero plane


def near(nearest: float) -> tuple[Gaussians, Panel, Rig]:
    """A third of the Gaussians stands near the cameras, so that their colours vary fast over the rig."""
    random, depth, count = np.random.default_rng(2), 2.0, 60
    z = np.r_[random.uniform(nearest, 2 * nearest, count // 3), random.uniform(0.8, 1.2, 2 * count // 3)] * depth
    fields = (
        np.c_[random.uniform(-0.5, 0.5, count) * z, random.uniform(-0.25, 0.25, count) * z, z],
        random.normal(size=(count, 4)),
        np.full((count, 3), 0.04) * z[:, None],
        random.uniform(0.4, 1, count),
        random.normal(size=(count, 16, 3)) * 0.2,
    )
    panel = Panel(width_px=64, height_px=32, views=96, line_number=9.848, slant_tan=1 / 6, cone_deg=53)
    rig = Rig(np.eye(4), (64.0, 64.0), (32.0, 16.0), depth)
    return Gaussians(*(torch.tensor(field, dtype=torch.float32) for field in fields)), panel, rig


def fine(degree: int) -> Gaussians:
    """Specks, lines and discs, most of them thinner than a pixel."""
    scene = scene_of(degree)
    shapes = torch.tensor([[0.2, 0.2, 0.2], [0.02, 3, 0.02], [1, 1, 1e-4]])
    scene.scales *= shapes[torch.arange(scene.count) % 3]
    scene.opacities[::2] = 1
    return scene


def beams() -> Gaussians:
    """Lines hundreds of pixels long and a twelfth of one wide, at every angle."""
    scene = blades()
    return replace(scene, scales=scene.scales.clamp_min(0.01))


CROWD = 4900


def crowd() -> tuple[Gaussians, Panel, Rig]:
    """Faint small Gaussians at three depths, hundreds in the lower of two tiles and thousands in the upper."""
    panel, random = panel_of("narrow cone"), torch.Generator().manual_seed(3)
    scene = cloud(CROWD, 11)
    depths = 1.9 + 0.1 * torch.randint(3, (CROWD,), generator=random)
    place = torch.rand(CROWD, 2, generator=random) * torch.tensor([1.8, 1.1]) - torch.tensor([0.95, 0.55])
    return (
        replace(
            scene,
            means=torch.cat([place, depths[:, None]], 1),
            scales=torch.full((CROWD, 3), 0.05),
            opacities=0.01 + 0.05 * scene.opacities,
        ),
        panel,
        rig_of(panel),
    )


def needles() -> tuple[Gaussians, Panel, Rig]:
    """A sheet of flat Gaussians, and four that point at a narrow rig: their S is about 1 + s^2 / 3."""
    panel, flat = panel_of("narrow cone"), sheet(48)
    flat.scales[:, 2] = 1e-4
    means = torch.tensor([[-0.5, -0.3, 1.9], [0.2, -0.2, 1.9], [-0.3, 0.3, 1.9], [0.4, 0.25, 1.9]])
    x, y, z = torch.nn.functional.normalize(means).unbind(1)
    towards = torch.stack([1 + z, -y, x, 0 * x], 1)  # turns the z axis to the mean
    parts = [
        (flat.means, means),
        (flat.quaternions, towards),
        (flat.scales, torch.tensor([[0.02, 0.02, 0.44]] * 4)),
        (flat.opacities, torch.full((4,), 0.9)),
        (flat.sh, torch.full((4, 1, 3), -1.5)),
    ]
    return Gaussians(*(torch.cat(part) for part in parts)), panel, rig_of(panel)


WIDE_QUALITY = replace(Quality.of("high"), evaluation_error=0.0)  # a lattice, and nothing in halves


def wide_rig() -> tuple[Gaussians, Panel, Rig]:
    """Small Gaussians, S of which varies much over the rig: of some about like 1 + a s + 3/4 a^2 s^2."""
    panel, scene = Panel(**{**LENS, "width_px": 397, "height_px": 131}), sheet(48, 11)
    scene.scales.mul_(0.4)
    return scene, panel, rig_of(panel)


def speckled() -> tuple[Gaussians, Panel, Rig]:
    """Gaussians large enough for lattices, of colours that none of them shows well enough."""
    _, panel, rig = wide_rig()
    scene = sheet(16, 11)
    scene.sh = 4 * torch.randn(scene.sh.shape, generator=torch.Generator().manual_seed(2))
    return scene, panel, rig


# Kernel, and a scene of which a part has no good polynomial, though the leading term of its error is nothing
SHAPES_THAT_VARY = [
    ("pixel", wide_rig),
    ("pixel-small", wide_rig),
    ("pixel-quadratic", needles),
    ("pixel-quadratic-small", needles),
]


# Kernel, panel, SH degree, views, and what colours are multiplied by; of frames evaluated in half precision
HALF_QUALITY, HALF_MOST, HALF_MEAN_SQUARE = Quality(evaluation_error=0.02), 0.01, 3e-6  # 55 dB
HALF_FRAMES = [
    ("pixel", dict(), 0, "integer", 1),
    ("pixel-small", dict(slant_tan=-0.18), 0, "continuous", 1),
    ("pixel", dict(subpixel_order="BGR"), 1, "continuous", 1),
    ("pixel-small", dict(views=1), 1, "integer", 1),
    ("pixel", dict(invert_views=True, line_number=16.013), 0, "integer", 12),
]


def half_frame(changes: dict[str, Any], degree: int, brightness: float) -> tuple[Gaussians, Panel, Rig]:
    """A panel in a narrow cone, and a scene; of brightness 12, half of it is too bright for half precision."""
    panel, scene = Panel(**{**LENS, "cone_deg": 4.0, **changes}), scene_of(degree)
    scene.sh[::2] *= brightness
    return scene, panel, rig_of(panel)


def images_step(dtype: torch.dtype) -> dict[str, Tensor]:
    """Images of two scenes before three cameras, and the gradients of a loss on them."""
    panel = Panel(**{**LENS, "width_px": 45, "height_px": 21, "views": 3})
    scenes = [with_harmonics(sheet(16, seed), 1) for seed in range(2)]
    leaves = {f: torch.stack([s.fields()[f] for s in scenes]).to(dtype).requires_grad_() for f in scenes[0].fields()}
    cameras = rig_of(panel).cameras(panel).to(dtype=dtype)
    views: list[Any] = [
        t.expand(2, *t.shape).contiguous() for t in (cameras.world_to_camera, cameras.intrinsics(), cameras.limits())
    ]
    outputs = torch.ops.lightfield_gs.render_images(
        *leaves.values(), torch.full((2, 3, 3), 0.3, dtype=dtype), *views, panel.width_px, panel.height_px
    )
    random = torch.Generator().manual_seed(5)
    loss = sum((out * torch.randn(out.shape, generator=random).to(out)).sum() for out in outputs)
    gradients = torch.autograd.grad(loss, list(leaves.values()))
    return dict(zip(("image", "alpha", "depth", *leaves), (*(out.detach() for out in outputs), *gradients)))


def sorted_frame(memory_budget: int | None) -> tuple[Tensor, dict[str, int]]:
    """A frame by `sorted`, and the bytes of its stages together: of the largest chunk, and of all views at once."""
    panel, stats = Panel(**{**LENS, "views": 12, "line_number": 9.3, "width_px": 133}), {}
    image = encode(
        scene_of(1),
        panel,
        rig_of(panel),
        "sorted",
        background=BACKGROUND,
        output="float32",
        memory_budget=memory_budget,
        stats=stats,
    )
    return image, {name: sum(stats[name].values()) for name in ("memory_bytes", "memory_bytes_unchunked")}


# Batch, channels, groups, height, width, and the mean of the features, which are about 1 apart
NORMS = [
    (2, 64, 16, 12, 10, 0.0),
    (1, 192, 32, 5, 7, -3.0),
    (3, 10, 5, 1, 1, 1.0),
    (1, 1024, 2, 2, 3, 0.5),
    (2, 8, 1, 40, 33, 40.0),
]


def norm_case(
    batch: int, channels: int, groups: int, height: int, width: int, mean: float
) -> tuple[torch.nn.GroupNorm, Tensor]:
    """A norm and features for group_norm_silu, in bfloat16 and channels last."""
    random = torch.Generator().manual_seed(channels)
    norm = torch.nn.GroupNorm(groups, channels, eps=1e-6).requires_grad_(False)
    for parameter in (norm.weight, norm.bias):
        parameter.copy_(torch.randn(channels, generator=random))
    features = mean + torch.randn(batch, channels, height, width, generator=random)
    return norm.bfloat16(), features.bfloat16().to(memory_format=torch.channels_last)


def norm_expected(norm: torch.nn.GroupNorm, features: Tensor) -> Tensor:
    weight, bias = norm.weight.double(), norm.bias.double()
    return torch.nn.functional.silu(
        torch.nn.functional.group_norm(features.double(), norm.num_groups, weight, bias, norm.eps)
    )
