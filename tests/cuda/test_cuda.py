"""The CUDA stages against the CPU's: the same scenes, panels and cameras. Needs a GPU."""

from __future__ import annotations

import pytest
import torch
from cuda_on_cpu.cases import (
    BACKGROUND,
    HALF_FRAMES,
    HALF_MEAN_SQUARE,
    HALF_MOST,
    HALF_QUALITY,
    LATTICE_FRAMES,
    OPTICS,
    crowd,
    half_frame,
    lattice_frame,
    optics_gradients,
)
from cuda_on_cpu.cases import rig_of as rig
from rasterizer_cases import CELLS, MIRRORED

from lightfield_gs import Encoder, Gaussians, InputError, Panel, Quality, _core, encode, prune, render
from lightfield_gs.bench.scenes import cloud, sheet
from lightfield_gs.rasterizer import frame_cuda

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)

LENS = dict(
    width_px=397,
    height_px=131,
    views=96,
    line_number=9.848282191911,
    slant_tan=1 / 6,
    phase=-2161.2044846576,
    cone_deg=40.0,
)
PANELS = {
    "default": {},
    "leaning the other way, BGR": dict(slant_tan=-0.18, subpixel_order="BGR", line_number=16.013),
    "inverted": dict(invert_views=True),
    "narrow lenses": dict(views=9, line_number=2.6),
    "one view": dict(views=1),
    "narrow cone": dict(cone_deg=4.0),
    "cells": dict(line_number=19.17, slant_tan=0.1455, subpixel_cells=CELLS, cell_pattern=2),
    "cells of four rows": dict(subpixel_cells=CELLS + CELLS[::-1], cell_pattern=3, cell_rows="top"),
    "cells that exchange colours": dict(subpixel_cells=MIRRORED, cell_pattern=1, slant_tan=-0.18),
}


def with_harmonics(scene: Gaussians, degree: int) -> Gaussians:
    noise = 0.15 * torch.randn(scene.count, (degree + 1) ** 2 - 1, 3, generator=torch.Generator().manual_seed(1))
    return Gaussians(scene.means, scene.quaternions, scene.scales, scene.opacities, torch.cat([scene.sh, noise], 1))


def on_gpu(scene: Gaussians) -> Gaussians:
    return scene.to(device="cuda")


def scene_of(degree: int) -> Gaussians:
    return with_harmonics(cloud(4000, 11) if degree else sheet(48, 11), degree)


@pytest.fixture(params=[0, 1, 3])
def scene(request) -> Gaussians:
    return scene_of(request.param)


def far_apart(a: torch.Tensor, b: torch.Tensor) -> int:
    """How many samples differ by more than 1/255: only those that sit on a threshold may."""
    return int(((a - b.cpu()).abs() > 1 / 255).sum())


def most_apart(a: torch.Tensor, b: torch.Tensor) -> int:
    """Largest difference of two 8-bit images."""
    return int((a.to(torch.int16) - b).abs().max())


@pytest.mark.parametrize("views", ["integer", "continuous"])
@pytest.mark.parametrize("panel", PANELS)
def test_light_field_is_that_of_the_cpu(scene, panel, views):
    panel = Panel(**{**LENS, **PANELS[panel]})
    options = dict(views=views, background=BACKGROUND, output="float32")
    expected, found = (encode(s, panel, rig(panel), **options) for s in (scene, on_gpu(scene)))
    assert found.is_cuda and far_apart(expected, found) <= 3
    assert ((expected - found.cpu()) ** 2).mean() < 1e-8  # 80 dB


@pytest.mark.parametrize("views", ["integer", "continuous"])
@pytest.mark.parametrize("panel", PANELS)
@pytest.mark.parametrize("kernel", _core.cuda.FRAME_KERNELS if hasattr(_core, "cuda") else [])
def test_every_kernel_draws_the_light_field_of_the_cpu(scene, panel, views, kernel, monkeypatch):
    monkeypatch.setattr(frame_cuda, "forced_kernel", kernel)
    panel = Panel(**{**LENS, **PANELS[panel]})
    if kernel == "lens-column" and (panel.line_number < 4 or panel.subpixel_cells == MIRRORED):
        pytest.skip("lenses of fewer than 4 sub-pixels, or places of several colours, are not for this kernel")
    options = dict(views=views, background=BACKGROUND, output="float32")
    expected, found = (encode(s, panel, rig(panel), **options) for s in (scene, on_gpu(scene)))
    assert far_apart(expected, found) <= 3
    assert ((expected - found.cpu()) ** 2).mean() < (1e-7 if kernel in ("pixel", "pixel-small") else 1e-8)


@pytest.mark.parametrize("kernel, changes, degree, views, brightness", HALF_FRAMES)
def test_half_precision_is_within_its_bound(kernel, changes, degree, views, brightness, monkeypatch):
    monkeypatch.setattr(frame_cuda, "forced_kernel", kernel)
    options = dict(views=views, background=BACKGROUND, output="float32")
    scene, panel, fan = half_frame({**changes, "width_px": 397, "height_px": 131}, degree, brightness)
    expected = encode(scene, panel, fan, **options)
    found = encode(on_gpu(scene), panel, fan, quality=HALF_QUALITY, **options).cpu()
    error = (found - expected).abs() / expected.clamp(min=1)
    assert 2e-4 < error.max() <= HALF_MOST
    assert (error**2).mean() < HALF_MEAN_SQUARE


def test_the_exact_operator_draws_the_light_field_of_the_cpu(scene):
    panel = Panel(**LENS)
    leaf = scene.means.cuda().requires_grad_()
    differentiable = Gaussians(leaf, *list(on_gpu(scene).fields().values())[1:])
    expected = encode(scene, panel, rig(panel), output="float32")
    found = encode(differentiable, panel, rig(panel), output="float32").detach()
    assert far_apart(expected, found) <= 3 and (expected - found.cpu()).abs().mean() < 1e-6


@pytest.mark.parametrize("kernel", _core.cuda.FRAME_KERNELS if hasattr(_core, "cuda") else [])
def test_a_frame_with_too_few_places_is_drawn_right(scene, kernel, monkeypatch):
    monkeypatch.setattr(frame_cuda, "forced_kernel", kernel)
    panel = Panel(**{**LENS, "views": 95})
    expected = encode(on_gpu(scene), panel, rig(panel))
    known = next(reversed(frame_cuda._known.values()))
    known.capacity, known.noted = 10, None
    assert most_apart(encode(on_gpu(scene), panel, rig(panel)), expected) <= 1  # other batches, other rounding
    torch.cuda.synchronize()
    assert known.adapt() and known.capacity > 10


@pytest.mark.parametrize("kernel", _core.cuda.FRAME_KERNELS if hasattr(_core, "cuda") else [])
def test_lists_of_any_length_are_in_order(kernel, monkeypatch):
    monkeypatch.setattr(frame_cuda, "forced_kernel", kernel)
    scene, panel, fan = crowd()
    expected, found = (encode(s, panel, fan, background=BACKGROUND, output="float32") for s in (scene, on_gpu(scene)))
    assert ((expected - found.cpu()) ** 2).mean() < (1e-7 if kernel in ("pixel", "pixel-small") else 1e-8)


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("kernel, quality, views, changes", LATTICE_FRAMES)
def test_what_is_smooth_is_drawn_from_a_lattice(kernel, quality, views, changes, degree, monkeypatch):
    monkeypatch.setattr(frame_cuda, "forced_kernel", kernel)
    scene, panel, fan = lattice_frame(changes, degree)
    options, stats = dict(views=views, background=BACKGROUND, output="float32"), {}
    exact = encode(scene, panel, fan, **options).clamp(0, 1)
    found = encode(on_gpu(scene), panel, fan, quality=quality, stats=stats, **options)
    error = (found.cpu().clamp(0, 1) - exact).abs()
    assert stats["kernel"] == kernel and min(stats["skipped"]["tiles"].values()) >= 2
    assert (error**2).mean() < {"high": 1e-5, "fast": 1e-4}[quality]
    assert error[:, :64].max() <= 2 * Quality.of(quality).lattice_error  # smooth there
    again = encode(on_gpu(scene), panel, fan, quality=quality, **options)
    assert torch.equal(found, again)
    bytes_ = encode(on_gpu(scene), panel, fan, quality=quality, **{**options, "output": "uint8"})
    assert ((255 * found.clamp(0, 1)).round() - bytes_).abs().sum() <= 3  # ties
    assert torch.equal(bytes_, Encoder(panel, fan, views=views, background=BACKGROUND, quality=quality)(on_gpu(scene)))


def test_an_exact_frame_has_no_lattice(scene):
    panel, stats = Panel(**LENS), {}
    encode(on_gpu(scene), panel, rig(panel), stats=stats)
    assert "tiles" not in stats["skipped"]


@pytest.mark.parametrize("kernel", _core.cuda.FRAME_KERNELS if hasattr(_core, "cuda") else [])
def test_a_frame_is_pruned_as_on_the_cpu(scene, kernel, monkeypatch):
    monkeypatch.setattr(frame_cuda, "forced_kernel", kernel)
    panel, stats = Panel(**LENS), ({}, {})
    scene.scales.mul_(0.4)
    options = dict(quality=Quality(contribution_cut=0.4), output="float32")
    expected, found = (
        encode(s, panel, rig(panel), stats=counted, **options) for s, counted in zip((scene, on_gpu(scene)), stats)
    )
    pruned = [counted["skipped"]["gaussians"]["pruned"] for counted in stats]
    assert 0 < pruned[0] == pruned[1] < scene.count
    assert far_apart(expected, found) <= 3


def test_a_scene_is_pruned_as_on_the_cpu(scene):
    panel, cut = Panel(**LENS), 0.01
    expected, found = (prune(s, panel, rig(panel), cut) for s in (scene, on_gpu(scene)))
    assert found.means.is_cuda and abs(found.count - expected.count) <= 2 + scene.count // 1000
    whole, fewer = (encode(s, panel, rig(panel), output="float32") for s in (on_gpu(scene), found))
    assert 0 < (whole.clamp(0, 1) - fewer.clamp(0, 1)).abs().mean() <= cut + 1e-4


@pytest.mark.parametrize("quality", ["high", "fast", "draft"])
def test_an_empty_light_field_of_any_quality(quality):
    panel = Panel(**LENS)
    nothing = Gaussians(*(field[:0] for field in sheet(48, 11).fields().values()))
    found = encode(on_gpu(nothing), panel, rig(panel), quality=quality, background=(1, 0, 0.5))
    assert (found.cpu() == torch.tensor([255, 0, 128], dtype=torch.uint8)).all()


def test_bytes_are_the_rounded_floats(scene):
    panel = Panel(**LENS)
    floats, bytes_ = (encode(on_gpu(scene), panel, rig(panel), output=output) for output in ("float32", "uint8"))
    assert torch.equal(bytes_, (255 * floats.clamp(0, 1)).round().to(torch.uint8))  # ties to even, both


def test_more_pairs_than_31_bits_number(monkeypatch):
    """Every splat covers the panel; what lies behind the nearest few hundred is not seen."""
    if torch.cuda.mem_get_info()[0] < 80 * 2**30:
        pytest.skip("needs 80 GiB of free device memory")
    monkeypatch.setattr(frame_cuda, "forced_kernel", "pixel")
    panel, count, near = Panel(7680, 3840, 96, line_number=16.013, slant_tan=0.18, cone_deg=1.0), 160_000, 600
    means = torch.zeros(count, 3)
    means[:, 2] = torch.linspace(1.9, 2.1, count)
    random = torch.Generator().manual_seed(3)
    scene = on_gpu(
        Gaussians(
            means,
            torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous(),
            torch.full((count, 3), 1.0),
            torch.full((count,), 0.5),
            torch.rand(count, 1, 3, generator=random),
        )
    )
    stats = {}
    found = encode(scene, panel, rig(panel), stats=stats)
    assert stats["pairs"] > 2**31
    nearest = Gaussians(*(field[:near].contiguous() for field in scene.fields().values()))
    assert most_apart(found, encode(nearest, panel, rig(panel))) <= 1


def test_an_encode_can_be_captured_once_its_kind_is_known(scene):
    panel, scene = Panel(**{**LENS, "views": 94}), on_gpu(scene)
    encode(scene, Panel(**LENS), rig(panel))  # loads what is loaded late
    graph = torch.cuda.CUDAGraph()
    with pytest.raises(InputError, match="encode once before"):
        with torch.cuda.graph(graph):
            encode(scene, panel, rig(panel))
    expected = encode(scene, panel, rig(panel))
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        image = encode(scene, panel, rig(panel))
    image.zero_()
    known = next(reversed(frame_cuda._known.values())).host
    torch.cuda.synchronize()
    known.zero_()
    graph.replay()
    assert torch.equal(image, expected)
    assert not known.any()  # memory of the kind, which the graph may outlive


def test_an_image_to_draw_over_begins_at_an_even_address(scene):
    panel, buffer = (
        Panel(**LENS),
        torch.empty(1 + 3 * LENS["width_px"] * LENS["height_px"], dtype=torch.uint8, device="cuda"),
    )
    with pytest.raises(InputError, match="even address"):
        encode(on_gpu(scene), panel, rig(panel), out=buffer[1:].view(panel.height_px, panel.width_px, 3))


def test_images_are_those_of_the_cpu(scene):
    panel = Panel(**LENS)
    cameras = rig(panel).cameras(panel, range(0, 96, 19))
    expected, found = (
        render(s, cameras, background=BACKGROUND, alpha=True, depth=True)[:3] for s in (scene, on_gpu(scene))
    )
    for a, b in zip(expected, found):
        assert far_apart(a, b) <= 5


def test_classic_is_that_of_the_cpu(scene):
    panel = Panel(**{**LENS, "views": 9})
    expected, found = (encode(s, panel, rig(panel), "classic", output="float32") for s in (scene, on_gpu(scene)))
    assert found.is_cuda and far_apart(expected, found) <= 3


@pytest.mark.parametrize("count", [0, 1])
def test_few_gaussians(count):
    scene = sheet(48, 11)
    scene = Gaussians(*(field[:count] for field in scene.fields().values()))
    panel = Panel(**LENS)
    assert torch.equal(encode(scene, panel, rig(panel)), encode(on_gpu(scene), panel, rig(panel)).cpu())


@pytest.fixture
def bright_scene(scene) -> Gaussians:
    """The scene with colours well above zero: at the clamp there, the gradient jumps with the last digit."""
    return Gaussians(*list(scene.fields().values())[:4], torch.cat([scene.sh[:, :1] + 3, scene.sh[:, 1:]], 1))


def gradients(scene: Gaussians, views: int, device: str) -> list[torch.Tensor]:
    """Of a loss on image, alpha and depth: the five fields, the background and the poses; float64 on the CPU."""
    dtype = torch.float64 if device == "cpu" else torch.float32
    panel = Panel(**{**LENS, "width_px": 133, "height_px": 61, "views": views})
    cameras = rig(panel).cameras(panel).to(device=device, dtype=dtype)
    leaves = [t.to(device=device, dtype=dtype)[None].requires_grad_() for t in scene.fields().values()]
    background = torch.full((1, views, 3), 0.3, device=device, dtype=dtype, requires_grad=True)
    poses = cameras.world_to_camera[None].clone().requires_grad_()
    outputs = torch.ops.lightfield_gs.render_images(
        *leaves, background, poses, cameras.intrinsics()[None], cameras.limits()[None], panel.width_px, panel.height_px
    )
    random = torch.Generator().manual_seed(5)
    loss = sum((out * torch.randn(out.shape, generator=random).to(out)).sum() for out in outputs)
    return list(torch.autograd.grad(loss, [*leaves, background, poses]))


def test_gradients_are_those_of_float64_on_the_cpu(bright_scene):
    for expected, found in zip(gradients(bright_scene, 3, "cpu"), gradients(bright_scene, 3, "cuda")):
        error = (found.cpu().double() - expected).norm() / expected.norm()
        assert error < 1e-3


def test_gradients_are_the_same_in_every_run(scene):
    for a, b in zip(gradients(scene, 3, "cuda"), gradients(scene, 3, "cuda")):
        assert torch.equal(a, b)


def lens_gradients(scene: Gaussians, panel: str, device: str) -> list[torch.Tensor]:
    """Of a loss on a light field: the five fields and the background; float64 on the CPU."""
    dtype = torch.float64 if device == "cpu" else torch.float32
    panel = Panel(**{**LENS, **PANELS[panel], "width_px": 133, "height_px": 61})
    scene = Gaussians(*(t.to(device=device, dtype=dtype).requires_grad_() for t in scene.fields().values()))
    background = torch.full((3,), 0.3, device=device, dtype=dtype, requires_grad=True)
    image = encode(scene, panel, rig(panel), background=background, output="float64" if device == "cpu" else "float32")
    loss = (image * torch.randn(image.shape, generator=torch.Generator().manual_seed(5)).to(image)).sum()
    return list(torch.autograd.grad(loss, [*scene.fields().values(), background]))


@pytest.mark.parametrize("panel", PANELS)
def test_lens_gradients_are_those_of_float64_on_the_cpu(bright_scene, panel):
    for expected, found in zip(lens_gradients(bright_scene, panel, "cpu"), lens_gradients(bright_scene, panel, "cuda")):
        assert (found.cpu().double() - expected).norm() < 1e-3 * expected.norm()


def test_lens_gradients_are_the_same_in_every_run(scene):
    for a, b in zip(lens_gradients(scene, "default", "cuda"), lens_gradients(scene, "default", "cuda")):
        assert torch.equal(a, b)


@pytest.mark.parametrize("case", OPTICS)
def test_gradients_to_optics_are_those_of_float64_on_the_cpu(case):
    found = optics_gradients(*case, torch.float32, "cuda")
    for name, expected in optics_gradients(*case, torch.float64).items():
        error = (found[name].cpu().double() - expected).norm() / expected.norm()
        assert error < (1e-4 if name == "image" else 3e-3), name  # an alpha may be on its cut


def test_gradients_to_optics_are_the_same_in_every_run():
    first, second = (optics_gradients(*OPTICS[1], torch.float32, "cuda") for _ in range(2))
    for name, found in first.items():
        assert torch.equal(found, second[name]), name


def test_nothing_drawn_has_zero_gradients():
    scene = sheet(8)
    scene = Gaussians(scene.means - torch.tensor([0, 0, 100.0]), *list(scene.fields().values())[1:])
    assert all(not g.any() for g in gradients(scene, 1, "cuda")[:5])


def test_what_is_missing_is_said(scene):
    panel = Panel(**LENS)
    with pytest.raises(InputError, match="float32"):
        encode(on_gpu(scene), panel, rig(panel), output="float64")
