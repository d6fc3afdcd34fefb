"""The work of a frame against stored figures: counters of the stages, and ratios of times, but never seconds.

The counters do not depend on the machine: one thread, one vector instruction set that every x86-64-v2 processor has.
They see more intersections, more evaluations, more memory. The ratios see a slower evaluation, or a stage without a
counter. They are of processor time, to which other programs do not add. Each is the least of several runs by turns, and
is tried again before it fails. A slower `direct` or training step makes its ratio fall.

After an intended change, on an idle machine: python tests/house/test_performance.py --renew
"""

from __future__ import annotations

import json
import platform
import sys
import time
from pathlib import Path

import pytest
import torch
from panel_cases import template_panel

from lightfield_gs import _core, build_info, encode, render
from lightfield_gs.bench.scenes import benchmark_rig, load_scene

STORED = Path(__file__).with_name("performance.json")
TARGET = "SSE4"
COUNTERS = ("pairs", "evaluations", "work_bytes", "gaussians_culled")
MORE, LESS = 1.02, 0.9  # compilers round differently; what does with much less wants its figures renewed
SLOWER, ATTEMPTS = 1.5, 3  # of ratios of times; with more runs by turns each time
FRAMES = {
    f"{scene} {cone} degrees {method}": (scene, cone, method)
    for scene in ("sheet:96", "cloud:20000")
    for cone in (5.0, 40.0)
    for method in ("direct", "sorted")
}
PANEL = template_panel(640, 320, 96)

pytestmark = pytest.mark.skipif(
    platform.machine() != "x86_64" or TARGET not in build_info()["simd_targets"],
    reason=f"figures are of the {TARGET} code",
)


def draw(scene, cone, method, **options):
    gaussians = load_scene(scene)
    return encode(gaussians, PANEL, benchmark_rig(scene, gaussians, PANEL, cone), method, threads=1, **options)


def counted(frame):
    _core.set_simd_target(TARGET)
    try:
        stats = {}
        draw(*FRAMES[frame], stats=stats)
    finally:
        _core.set_simd_target("")
    return {name: stats[name] for name in COUNTERS}


def training_step():
    gaussians = load_scene("sheet:96")
    fields = [field.requires_grad_() for field in gaussians.fields().values()]
    cameras = benchmark_rig("sheet:96", gaussians, PANEL, 40.0).cameras(PANEL, [0, 48]).to(torch.float32)
    torch.autograd.grad(render(gaussians, cameras).image.square().sum(), fields)


# How many times as long the second takes as the first
RATIOS = {
    "classic / direct, narrow": (lambda: draw("sheet:96", 5.0, "direct"), lambda: draw("sheet:96", 5.0, "classic")),
    "classic / direct, wide": (
        lambda: draw("cloud:20000", 40.0, "direct"),
        lambda: draw("cloud:20000", 40.0, "classic"),
    ),
    "classic / sorted": (lambda: draw("sheet:96", 40.0, "sorted"), lambda: draw("sheet:96", 40.0, "classic")),
    "exact / direct": (
        lambda: draw("sheet:96", 40.0, "direct"),
        lambda: draw("sheet:96", 40.0, "direct", output="float64"),
    ),
    "classic / training step": (training_step, lambda: draw("sheet:96", 5.0, "classic")),
}


def ratio(name, runs=4):
    def seconds(function):
        start = time.process_time()
        function()
        return time.process_time() - start

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    _core.set_simd_target(TARGET)
    try:
        times = [[seconds(function) for function in RATIOS[name]] for _ in range(runs)]
    finally:
        _core.set_simd_target("")
        torch.set_num_threads(before)
    first, second = map(min, zip(*times))
    return second / first


@pytest.mark.parametrize("frame", FRAMES)
def test_counters_are_the_stored_ones(frame):
    stored = json.loads(STORED.read_text())["counters"][frame]
    for name, found in counted(frame).items():
        assert LESS * stored[name] <= found <= MORE * stored[name], f"{name}: {found}, stored {stored[name]}"


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.not_sanitized
@pytest.mark.parametrize("name", RATIOS)
def test_no_method_has_become_slower_beside_another(name):
    stored = json.loads(STORED.read_text())["ratios"][name]
    assert any(ratio(name, 4 * (1 + attempt)) > stored / SLOWER for attempt in range(ATTEMPTS))


if __name__ == "__main__":
    if sys.argv[1:] != ["--renew"]:
        sys.exit(__doc__)
    figures = {
        "counters": {frame: counted(frame) for frame in FRAMES},
        "ratios": {name: round(ratio(name), 2) for name in RATIOS},
    }
    STORED.write_text(json.dumps(figures, indent=1) + "\n")
