"""Light fields by WebGPU, feature by feature: the bytes of the CPU to 1/255, and the float64 oracle."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterizer_cases import all_subpixels, hard_scene, panel, random_scene, rig

from lightfield_gs import encode, reference
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import panel_lens
from lightfield_gs.rasterizer.quality import Quality
from lightfield_gs.webgpu import devices
from lightfield_gs.webgpu.buffers import Buffers, Limits
from lightfield_gs.webgpu.frames import Frames
from lightfield_gs.webgpu.parameters import tilings
from lightfield_gs.webgpu.plans import Bands

# The drivers of GPUs are not ours, and what is drawn on the CPU is tested elsewhere
pytestmark = pytest.mark.not_sanitized

BACKGROUND = (0.1, 0.6, 0.3)
SETTLED = 2e-3  # samples whose decisions came nearer to a threshold than this may differ in float32

# What is not as usual: of the panel, of the scene, of encode
FEATURES = {
    "stripes": ({}, {}, {}),
    "other way, BGR": (dict(slant_tan=-0.18, subpixel_order="BGR", phase=-7.25, line_number=16.013), {}, {}),
    "inverted, very wide cone": (dict(invert_views=True, cone_deg=90.0), {}, {}),
    "continuous views": ({}, {}, dict(views="continuous")),
    "many views": (dict(views=65536), {}, {}),
    "one column": (dict(height_px=129, width_px=1), {}, {}),
    "harmonics of degree 1": ({}, dict(degree=1), {}),
    "harmonics of degree 3": ({}, dict(degree=3), {}),
    "colours on circles": (dict(cone_deg=120.0), dict(degree=3, depth=0.4, extent=0.3), {}),
    "anti-aliased": ({}, dict(size=0.004), dict(antialiased=True)),
    "view filter": ({}, {}, dict(view_filter=3.0)),
    "anti-aliased, harmonics, view filter": ({}, dict(degree=2), dict(antialiased=True, view_filter=2.0)),
    "floats": ({}, dict(degree=1), dict(output="float32")),
}
QUALITIES = {
    "opacity cut": Quality(opacity_cut=1 / 20),
    "stop": Quality(transmittance_stop=0.2),
    "contribution": Quality(contribution_cut=0.2),
    "cut, compensated": Quality(opacity_cut=1 / 32),
}
CELLS = ("cells", "cells of four rows", "cells that exchange colours", "cells far aside", "cells of narrow lenses")


def most_apart(a: torch.Tensor, b: torch.Tensor) -> float:
    """The largest difference, in bytes or as floats."""
    return float((a.double() - b.double()).abs().max())


def both(gaussians, shown, fan, **options):
    """The image by WebGPU, and the CPU's."""
    options = {"background": BACKGROUND, **options}
    return (encode(gaussians, shown, fan, device=where, **options) for where in ("webgpu", None))


def limited(frames: Frames, limits: Limits, monkeypatch) -> Frames:
    """Let an adapter of small limits draw."""
    small = Frames(frames.device, limits)
    monkeypatch.setattr(devices, "frames_on", lambda index: small)
    return small


@pytest.mark.parametrize("tiling", [0, 3])
@pytest.mark.parametrize("name", FEATURES)
def test_bytes_are_those_of_the_cpu(frames, name, tiling):
    of_panel, of_scene, options = FEATURES[name]
    shown = panel(**of_panel)
    frames.tiling = tiling
    gaussians = random_scene(60, **{"seed": len(name), "dtype": torch.float32, **of_scene})
    drawn, expected = both(gaussians, shown, rig(shown, 0.1, -0.15, (0.53, 0.44)), **options)
    assert (drawn.shape, drawn.dtype) == (expected.shape, expected.dtype)
    assert expected.double().std() > 0.05  # there is something to see
    assert most_apart(drawn, expected) <= (1 if drawn.dtype == torch.uint8 else 1 / 255)


@pytest.mark.parametrize("tiling", [0, 3])
@pytest.mark.parametrize("name", QUALITIES)
def test_qualities_skip_as_on_the_cpu(frames, name, tiling):
    shown, gaussians, frames.tiling = panel(), random_scene(60, seed=3, dtype=torch.float32), tiling
    options = dict(antialiased="compensated" in name, background=BACKGROUND)
    drawn, expected = both(gaussians, shown, rig(shown), quality=QUALITIES[name], **options)
    assert most_apart(drawn, expected) <= 1
    assert not torch.equal(expected, encode(gaussians, shown, rig(shown), **options))
    pruned = []
    for where in ("webgpu", None):
        stats: dict = {}
        encode(gaussians, shown, rig(shown), quality=QUALITIES[name], device=where, stats=stats, **options)
        pruned.append(stats["skipped"]["gaussians"]["pruned"])
    assert pruned[0] == pruned[1] and (pruned[0] > 0) == (name == "contribution")


@pytest.mark.parametrize("tiling", [0, 2, 3])
@pytest.mark.parametrize("name", CELLS)
def test_cells_of_any_pattern(frames, name, tiling):
    shown = panel(name)
    if tiling not in tilings(panel_lens(shown, False, 0.1, 0.1)):
        pytest.skip("cells that do not lie in the order of stripes, or narrow lenses")
    frames.tiling = tiling
    drawn, expected = both(random_scene(60, dtype=torch.float32), shown, rig(shown, 0.1, -0.15))
    assert most_apart(drawn, expected) <= 1


@pytest.mark.parametrize("tiling", [0, 2, 3, 6])
def test_every_subpixel_is_near_the_oracle(frames, tiling):
    frames.tiling = tiling
    shown, gaussians = panel(), random_scene(60, 1, seed=5)
    fan = rig(shown, 0.1, -0.15)
    want, margin = reference.subpixel_colours(
        gaussians, shown, fan, *all_subpixels(shown), background=BACKGROUND, return_margin=True
    )
    single = gaussians.to(dtype=torch.float32)
    image = encode(single, shown, fan, background=BACKGROUND, output="float32", device="webgpu").numpy().ravel()
    assert np.abs(image - want)[margin > SETTLED].max() < 1.5e-4


@pytest.mark.parametrize("kind", ["clamped", "needles", "huge", "opaque", "specks", "near and far"])
def test_gaussians_that_are_hard(frames, kind):
    shown = panel("very wide cone")
    drawn, expected = both(hard_scene(kind, 40, seed=3).to(dtype=torch.float32), shown, rig(shown, 0.1))
    assert most_apart(drawn, expected) <= 1


@pytest.mark.parametrize("count", [1500, 5000])
def test_lists_of_any_length_are_in_order(frames, count):
    """Faint Gaussians that cover the panel, so that the last of a list still shows, and many at one depth."""
    gaussians = random_scene(count, seed=1, size=0.5, dtype=torch.float32)
    gaussians.opacities[:] = 0.006
    gaussians.means[::2, 2] = 2.0
    shown = panel(width_px=40, height_px=20)
    drawn, expected = both(gaussians, shown, rig(shown), output="float32")
    assert most_apart(drawn, expected) < 1e-3


def test_an_empty_scene_is_background(frames):
    shown = panel()
    image = encode(random_scene(0, dtype=torch.float32), shown, rig(shown), background=BACKGROUND, device="webgpu")
    assert (image == torch.tensor([26, 153, 76])).all()


@pytest.mark.parametrize(("tiling", "output"), [(0, "uint8"), (3, "uint8"), (3, "float32")])
def test_small_limits_are_kept_by_parts_and_passes(frames, monkeypatch, tiling, output):
    """Harmonics in parts, the image in bands, lists in halves, a row of boxes at a time: the same bytes."""
    limits = Limits(96 * 1024, 128 * 1024)
    sizes, make = [], Buffers._make
    shown = panel(width_px=200, height_px=140)
    gaussians = random_scene(900, 3, size=0.03, dtype=torch.float32)
    frames.tiling = tiling
    drawn, expected = both(gaussians, shown, rig(shown, 0.1), output=output)

    def made(self, name: str, size: int, *usage: int) -> int:
        sizes.append((size, limits.buffer_bytes if usage else limits.most_bytes))
        return make(self, name, size, *usage)

    monkeypatch.setattr(Buffers, "_make", made)
    small = limited(frames, limits, monkeypatch)
    small.tiling, small.most_rows = tiling, 1
    again = encode(gaussians, shown, rig(shown, 0.1), background=BACKGROUND, device="webgpu", output=output)
    assert torch.equal(again, drawn) and most_apart(again, expected) <= (1 if output == "uint8" else 1 / 255)
    assert all(size <= most for size, most in sizes) and limits.most_bytes < 4 * 200 * 140


def test_bands_grow_by_the_rate_of_the_device():
    """At 1e10 instructions a second: 4e9, and then what takes 50 ms; a fast device grows by four each time."""
    slow, fast = Bands(None, 1e8), Bands(None, 1e8)
    assert slow.rows() == fast.rows() == 40
    slow.took(40, 0.4)
    fast.took(40, 0.0004)
    assert (slow.rows(), fast.rows()) == (5, 160)
    fast.took(160, 0.0016)
    assert fast.rows() == 640 and Bands(slow.rate, 1e8).rows() == 5


def test_a_scene_beyond_the_limits_is_refused(frames, monkeypatch):
    limited(frames, Limits(13312, 13312), monkeypatch)
    shown = panel()
    with pytest.raises(InputError, match="a scene of 900 Gaussians: needs a buffer .* use device cpu"):
        encode(random_scene(900, dtype=torch.float32), shown, rig(shown), device="webgpu")


def test_statistics_and_a_given_image(frames):
    shown, gaussians = panel(), random_scene(60, dtype=torch.float32)
    stats, out = {}, torch.empty(shown.height_px, shown.width_px, 3, dtype=torch.uint8)
    assert encode(gaussians, shown, rig(shown), device="webgpu", stats=stats, out=out) is out
    assert torch.equal(out, encode(gaussians, shown, rig(shown), device="webgpu"))
    assert stats["kernel"].startswith("webgpu-") and stats["evaluations"] is None
    assert stats["pairs"] > 0 and stats["work_bytes"] > 0 and 0 <= stats["gaussians_culled"] < 60


def test_what_webgpu_cannot_draw_is_refused():
    shown, gaussians = panel(), random_scene(5)
    fan = rig(shown)
    for words, given in (
        ("device= is for method 'direct', not 'sorted'", dict(method="sorted")),
        ("'float64' needs device=None", dict(output="float64")),
        ("expected webgpu or webgpu:N, got 'metal'", dict(device="metal")),
    ):
        with pytest.raises(InputError, match=words):
            encode(gaussians, shown, fan, **{"device": "webgpu", **given})
    wanted = replace(gaussians, opacities=gaussians.opacities.float().requires_grad_())
    with pytest.raises(InputError, match="device= is for images without gradients"):
        encode(wanted.to(dtype=torch.float32), shown, fan, output="float32", device="webgpu")
