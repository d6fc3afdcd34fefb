"""Very many Gaussians in one place, and panels of 16K: right, and done in time."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from rasterizer_cases import panel as panel_of
from rasterizer_cases import random_scene, rig
from stress_cases import BACKGROUND

from lightfield_gs import Gaussians, encode, reference
from lightfield_gs.reference.blend import LOW_PASS_PX2, Projection, Scene


def on_one_pixel(count: int, opacity: float) -> Gaussians:
    """In one line of sight, smaller than a pixel, each of another grey, at eight depths without any order."""
    random = np.random.default_rng(3)
    scene = Gaussians(
        torch.zeros(count, 3),
        torch.eye(4)[:1].repeat(count, 1),
        torch.full((count, 3), 1e-4),
        torch.full((count,), opacity),
        torch.zeros(count, 1, 3),
    )
    scene.means[:, 2] = torch.from_numpy(2 + 2.0**-22 * random.integers(0, 8, count))
    scene.sh[:, 0] = torch.from_numpy(random.uniform(-1, 1, (count, 1))).to(torch.float32)
    return scene


def blended(scene: Gaussians, weight: float, background: float) -> float:
    """One after the other from near to far, ties as they come, float64, until the transmittance would pass 1e-4."""
    order = torch.argsort(scene.means[:, 2], stable=True)
    light = (0.5 + 0.28209479177387814 * scene.sh[order, 0, 0].double()).tolist()
    alphas = (weight * scene.opacities[order].double()).clamp(max=0.99).tolist()
    total, left = 0.0, 1.0
    for value, alpha in zip(light, alphas):
        if alpha < 1 / 255:
            continue
        if left * (1 - alpha) < 1e-4:
            break
        total, left = total + left * alpha * value, left * (1 - alpha)
    return total + left * background


@pytest.mark.slow
@pytest.mark.parametrize("opacity", [1e-3, 5e-3, 0.9])
def test_a_million_on_one_pixel(opacity):
    scene = on_one_pixel(10**6, opacity)
    shown = panel_of(width_px=9, height_px=7, views=4)
    fan = rig(shown)
    image = encode(scene, shown, fan, background=BACKGROUND, output="float32")
    assert torch.isfinite(image).all()
    rows, columns, channels = (index.ravel() for index in np.indices((7, 9, 3)))
    offsets = reference.lens_offsets(shown, fan, reference.lens_views(shown, rows, columns, channels))
    one = Projection(Scene.from_gaussians(on_one_pixel(1, 1.0)), reference.rig_eye(shown, fan))
    u, v, across, down = one.footprint(torch.tensor([0]), torch.from_numpy(offsets))
    assert max(across.abs().max(), down.abs().max()) < 0.01  # the low pass is all there is of them
    squares = (torch.from_numpy(columns) + 0.5 - u) ** 2 + (torch.from_numpy(rows) + 0.5 - v) ** 2
    weights = torch.exp(-squares / (2 * LOW_PASS_PX2))
    for at in torch.topk(weights, 12).indices.tolist():
        want = blended(scene, float(weights[at]), BACKGROUND[channels[at]])
        assert float(image.view(-1)[at]) == pytest.approx(want, abs=5e-4)
    assert (image.view(-1)[int(weights.argmax())] != BACKGROUND[0]) == (opacity > 1 / 255)


@pytest.mark.slow
def test_a_panel_of_16k():
    shown = panel_of(width_px=16384, height_px=8192)
    scene, fan = random_scene(200, 1, seed=4, dtype=torch.float32), rig(shown)
    image = encode(scene, shown, fan, background=BACKGROUND)
    random = np.random.default_rng(6)
    where = [random.integers(0, size, 3000) for size in (8192, 16384, 3)]
    for index, last in zip(where, (8191, 16383, 2)):
        index[0] = last  # the very last sub-pixel too
    want, margin = reference.subpixel_colours(scene, shown, fan, *where, background=BACKGROUND, return_margin=True)
    error = np.abs(image.numpy()[tuple(where)] - 255 * want.clip(0, 1))
    assert error[margin > 5e-3].max() < 0.55 and (margin > 5e-3).mean() > 0.5
    assert len(np.unique(image.numpy()[tuple(where)])) > 50  # something is drawn


NO_MORE_THREADS = """
import resource
import torch
from lightfield_gs import Panel, Rig, encode
from lightfield_gs.bench.scenes import sheet
panel = Panel(30, 4096, 5, line_number=9.0, slant_tan=0.2)
scene = sheet(16)
rig = Rig.frame(scene, panel)
expected = encode(scene, panel, rig, threads=1)
status = dict(line.split(":\\t", 1) for line in open("/proc/self/status") if ":\\t" in line)
used = 1024 * int(status["VmSize"].split()[0])
resource.setrlimit(resource.RLIMIT_AS, (used + (40 << 20), used + (40 << 20)))
assert torch.equal(encode(scene, panel, rig, threads=256), expected)
"""


def test_where_the_system_starts_no_more_threads_those_there_are_do_the_work():
    plain = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}  # a sanitizer needs more room
    done = subprocess.run([sys.executable, "-c", NO_MORE_THREADS], capture_output=True, text=True, env=plain)
    assert done.returncode == 0, done.stderr
