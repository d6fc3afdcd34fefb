"""WebGPU at the extremes of stress_cases, and the large frames that take minutes on an adapter that is a program.

The large ones have the marker webgpu_large: `make test-webgpu` runs them.
"""

from dataclasses import replace

import pytest
import torch
from rasterizer_cases import panel, random_scene, rig
from stress_cases import BACKGROUND, CASES

from lightfield_gs import Panel, encode
from lightfield_gs.bench.scenes import benchmark_rig, load_scene
from lightfield_gs.panels.panel import panel_lens
from lightfield_gs.show.page.stage import cut_out
from lightfield_gs.webgpu.parameters import tilings

# The drivers of GPUs are not ours, and what is drawn on the CPU is tested elsewhere
pytestmark = pytest.mark.not_sanitized


def apart(gaussians, shown, fan, **options) -> tuple[torch.Tensor, dict]:
    """How far bytes by WebGPU are from the CPU's, and the statistics."""
    stats: dict = {}
    drawn = encode(gaussians, shown, fan, device="webgpu", stats=stats, **options)
    return (drawn.int() - encode(gaussians, shown, fan, **options).int()).abs(), stats


@pytest.mark.parametrize("tiling", [0, 3])
@pytest.mark.parametrize("name", CASES)
def test_extremes_have_the_bytes_of_the_cpu(frames, name, tiling):
    shown, fan = CASES[name].view()
    if tiling not in tilings(panel_lens(shown)):
        pytest.skip("lenses that no box is made of")
    frames.tiling = tiling
    difference, _ = apart(CASES[name].scene().to(dtype=torch.float32), shown, fan, background=BACKGROUND)
    assert difference.max() <= 1


@pytest.mark.webgpu_large
def test_pixels_of_an_8k_frame_in_a_wide_cone(frames):
    """Few bytes differ, for places and roots are as exact as on the CPU."""
    panel_8k, gaussians = Panel.load("bench-8k-96v"), load_scene("sheet:512", None)
    fan = benchmark_rig("sheet:512", gaussians, panel_8k, 40.0)
    difference, _ = apart(gaussians, *cut_out(panel_8k, fan, 3520, 1760, 640, 320))
    assert difference.max() <= 1 and (difference > 0).float().mean() < 2e-4


@pytest.mark.webgpu_large
def test_a_list_of_30000(frames):
    """Faint Gaussians, all of which cover the panel: a sample shows the nearest few hundred of them."""
    gaussians = random_scene(31_000, seed=1, size=0.5, dtype=torch.float32)
    gaussians.opacities[:] = 0.02
    shown = panel(width_px=32, height_px=16)
    difference, stats = apart(gaussians, shown, rig(shown))
    assert stats["pairs"] >= 30_000 and difference.max() <= 1


@pytest.mark.webgpu_large
def test_3_million_gaussians(frames):
    shown = replace(Panel.load("bench-8k-96v"), width_px=480, height_px=240)
    gaussians = load_scene("cloud:3000000", None)
    difference, stats = apart(gaussians, shown, benchmark_rig("cloud:3000000", gaussians, shown, 40.0))
    assert stats["gaussians_culled"] < 1_000_000 and difference.max() <= 1


@pytest.mark.webgpu_large
def test_a_panel_of_16k_is_drawn_in_passes(frames):
    """The upper half of one: its image of four bytes a pixel is twice a binding of 128 MiB."""
    shown = replace(Panel.load("bench-8k-96v"), width_px=15360, height_px=4320)
    gaussians = load_scene("sheet:4", None)
    before, frames.tiling = frames.submissions, 0
    difference, _ = apart(gaussians, shown, benchmark_rig("sheet:4", gaussians, shown, 5.0))
    assert frames.submissions >= before + 4 and difference.max() <= 1
