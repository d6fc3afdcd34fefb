"""Tiles of lenses on devices of less shared memory, forced by an environment variable. Needs a GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from cuda_on_cpu import cases
from rasterizer_cases import MIRRORED
from test_cuda import BACKGROUND, LENS, PANELS, far_apart, on_gpu, rig, scene_of

from lightfield_gs import Encoder, InputError, Panel, encode, reference
from lightfield_gs.bench.scenes import benchmark_rig, cloud, with_harmonics
from lightfield_gs.panels.rig import lenticular_camera
from lightfield_gs.rasterizer import frame_cuda
from lightfield_gs.rasterizer.direct import DirectRender
from lightfield_gs.rasterizer.quality import EXACT

WIDE = dict(width_px=1920, height_px=960, views=96, line_number=16.013, slant_tan=0.182, cone_deg=40.0)
PANELS_OF_LENSES = [
    name
    for name, changes in PANELS.items()
    if changes.get("line_number", 16) >= 4 and changes.get("subpixel_cells") != MIRRORED
]


def limit(monkeypatch: pytest.MonkeyPatch, bytes_: int | None) -> None:
    if bytes_ is None:
        monkeypatch.delenv(frame_cuda.SHARED_MEMORY_LIMIT, raising=False)
    else:
        monkeypatch.setenv(frame_cuda.SHARED_MEMORY_LIMIT, str(bytes_))


def layout(panel: Panel) -> str:
    job = DirectRender(
        on_gpu(scene_of(0)).fields().values(),
        torch.zeros(3, device="cuda"),
        lenticular_camera(panel, rig(panel), False),
    )
    return frame_cuda.DirectFrame(job, EXACT, 0, 0).native.lens_column_layout


def test_the_layout_is_the_largest_that_stands_twice_on_a_multiprocessor(monkeypatch):
    found = []
    for bytes_ in (cases.SMALL_SHARED_MEMORY, 48 * 1024):
        limit(monkeypatch, bytes_)
        found.append(layout(Panel(**LENS)))
    limit(monkeypatch, None)
    has_228_kb = torch.cuda.get_device_properties(0).shared_memory_per_multiprocessor >= 228 * 1024
    assert found == ["compact", "none"] and layout(Panel(**LENS)) == ("full" if has_228_kb else "compact")


@pytest.mark.parametrize("views", ["integer", "continuous"])
@pytest.mark.parametrize("panel", PANELS_OF_LENSES)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_compact_layout_draws_the_light_field_of_the_cpu(degree, panel, views, monkeypatch):
    limit(monkeypatch, cases.SMALL_SHARED_MEMORY)
    monkeypatch.setattr(frame_cuda, "forced_kernel", "lens-column")
    scene, panel = scene_of(degree), Panel(**{**LENS, **PANELS[panel]})
    options = dict(views=views, background=BACKGROUND)
    expected, found = (encode(s, panel, rig(panel), output="float32", **options) for s in (scene, on_gpu(scene)))
    assert far_apart(expected, found) <= 1 and ((found.cpu() - expected) ** 2).mean() < 1e-8
    bytes_ = encode(on_gpu(scene), panel, rig(panel), **options)
    assert torch.equal(bytes_, (255 * found.clamp(0, 1)).round().to(torch.uint8))
    encoder = Encoder(panel, rig(panel), **options)  # replays a graph
    assert torch.equal(encoder(on_gpu(scene)), bytes_)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_wide_cone_keeps_80_db_in_both_layouts(degree, monkeypatch):
    panel = Panel(**WIDE)
    scene = cloud(1 << 16)
    scene = with_harmonics(scene, degree) if degree else scene
    at = benchmark_rig("cloud:65536", None, panel, "wide")
    random = np.random.default_rng(3)
    where = [random.integers(0, size, 5000) for size in (panel.height_px, panel.width_px, 3)]
    expected = reference.subpixel_colours(scene, panel, at, *where, background=BACKGROUND)
    images, errors = [], []
    for bytes_ in (None, cases.SMALL_SHARED_MEMORY):
        limit(monkeypatch, bytes_)
        stats: dict[str, Any] = {}
        options = dict(background=BACKGROUND, output="float32", stats=stats)
        images.append(encode(on_gpu(scene), panel, at, **options).cpu())
        errors.append(np.abs(images[-1].numpy()[tuple(where)] - expected))
        assert stats["kernel"] == "lens-column" and (errors[-1] ** 2).mean() < 1e-8
    assert errors[1].mean() < 1.05 * errors[0].mean() + 1e-8  # as exact as the full layout
    assert (images[0] - images[1]).abs().max() < 1e-3


def test_compensated_opacities_in_the_compact_layout(monkeypatch):
    limit(monkeypatch, cases.SMALL_SHARED_MEMORY)
    monkeypatch.setattr(frame_cuda, "forced_kernel", "lens-column")
    panel = Panel(**LENS)
    for degree in (0, 3):
        scene = cases.fine(degree)
        options = dict(background=BACKGROUND, antialiased=True)
        expected, found = (encode(s, panel, rig(panel), output="float32", **options) for s in (scene, on_gpu(scene)))
        assert far_apart(expected, found) <= 1 and ((found.cpu() - expected) ** 2).mean() < 1e-8


def test_a_kernel_without_room_is_refused(monkeypatch):
    limit(monkeypatch, 48 * 1024)
    monkeypatch.setattr(frame_cuda, "forced_kernel", "lens-column")
    panel = Panel(**LENS)
    with pytest.raises(ValueError, match="lens-column kernel cannot draw"):
        encode(on_gpu(scene_of(0)), panel, rig(panel))
    monkeypatch.setenv(frame_cuda.SHARED_MEMORY_LIMIT, "99 KB")
    with pytest.raises(InputError, match="LFGS_SHARED_MEMORY_LIMIT: expected a number of bytes"):
        encode(on_gpu(scene_of(0)), panel, rig(panel))
