"""Anti-aliased scenes, filtered views and all models of cameras on CUDA, against oracle and CPU. Needs a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cuda_on_cpu import cases
from rasterizer_cases import MIRRORED
from test_cuda import BACKGROUND, LENS, PANELS, far_apart, most_apart, on_gpu, rig

from lightfield_gs import Encoder, Panel, encode, prune, reference, render
from lightfield_gs.base.options import CAMERA_MODELS

SOFTER = [
    dict(antialiased=True),
    dict(view_filter=cases.VIEW_FILTER),
    dict(antialiased=True, view_filter=cases.VIEW_FILTER),
]


@pytest.mark.parametrize("views", ["integer", "continuous"])
@pytest.mark.parametrize("panel", PANELS)
@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("softer", SOFTER)
def test_every_method_draws_what_the_cpu_does(softer, degree, panel, views):
    scene, panel = cases.fine(degree), Panel(**{**LENS, **PANELS[panel]})
    options = dict(views=views, background=BACKGROUND, **softer)
    # Of sub-pixels in other places there are too many continuous views to draw one after the other
    for method in ("direct",) if panel.subpixel_cells == MIRRORED and views == "continuous" else ("direct", "sorted"):
        expected, found = (
            encode(s, panel, rig(panel), method, output="float32", **options) for s in (scene, on_gpu(scene))
        )
        assert far_apart(expected, found) <= 1 and ((found.cpu() - expected) ** 2).mean() < 1e-8
    bytes_ = encode(on_gpu(scene), panel, rig(panel), **options)
    assert most_apart(bytes_, encode(scene, panel, rig(panel), **options).cuda()) <= 1


@pytest.mark.parametrize("quality", ["exact", "fast"])
@pytest.mark.parametrize("softer", SOFTER)
def test_frames_keep_80_db_and_say_which_kernel_drew_them(softer, quality):
    scene, panel, stats = cases.fine(1), Panel(**LENS), {}
    random = np.random.default_rng(1)
    where = [random.integers(0, size, 4000) for size in (panel.height_px, panel.width_px, 3)]
    image = (
        encode(
            on_gpu(scene),
            panel,
            rig(panel),
            background=BACKGROUND,
            output="float32",
            quality=quality,
            stats=stats,
            **softer,
        )
        .cpu()
        .numpy()
    )
    want = reference.subpixel_colours(scene, panel, rig(panel), *where, background=BACKGROUND, **softer)
    assert ((image[tuple(where)] - want) ** 2).mean() < {"exact": 1e-8, "fast": 1e-4}[quality]
    assert stats["kernel"] in ("pixel-quadratic", "pixel-quadratic-small", "lens-column")


def test_an_encoder_a_view_and_pruning_do_the_same():
    scene, panel = cases.fine(1), Panel(**LENS)
    encoder, there = Encoder(panel, rig(panel), antialiased=True), on_gpu(scene)
    encode(there, panel, rig(panel))  # a frame of the same sizes, without
    for _ in range(2):
        assert torch.equal(encoder(there), encode(there, panel, rig(panel), antialiased=True))
    cameras = rig(panel).cameras(panel, [0, 95])
    views = [render(s, cameras, antialiased=True).image.cpu() for s in (scene, there)]
    assert ((views[0] - views[1]) ** 2).mean() < 1e-8
    counts = [prune(s, panel, rig(panel), 1e-3, antialiased=True).count for s in (scene, there)]
    assert abs(counts[0] - counts[1]) <= 0.01 * scene.count


@pytest.mark.parametrize(
    ("sensor", "softer"),
    [
        *(("direct", softer) for softer in SOFTER),
        *(("images" if model == "pinhole" else model, dict(antialiased=True)) for model in CAMERA_MODELS),
        *((model, {}) for model in cases.CURVED),
    ],
)
@pytest.mark.parametrize("scene", [lambda: cases.fine(1), cases.beams])
def test_gradients_are_those_of_float64(sensor, softer, scene):
    found = cases.gradients(on_gpu(scene()), sensor, torch.float32, **softer)
    for name, expected in cases.gradients(scene(), sensor, torch.float64, **softer).items():
        error = (found[name].cpu().double() - expected).norm() / expected.norm()
        assert error < (1e-5 if name == "image" else 5e-3), name
