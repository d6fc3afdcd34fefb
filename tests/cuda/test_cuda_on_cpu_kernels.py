"""Frames of the CUDA stages, compiled for the CPU: what each kernel draws is what the CPU and the oracle do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from cuda_on_cpu import cases
from cuda_on_cpu.drawings import EMULATED

from lightfield_gs import encode, reference
from lightfield_gs.rasterizer import frame_cuda

pytestmark = EMULATED

DRAWN = (
    "pixel",
    "pixel-quadratic",
    "pixel-small",
    "pixel-quadratic-small",
    "lens-column",
    "compact",
    "shapes",
    "chosen",
    "widest",
    "half",
    "settings",
    "parabolas",
    "harmonics",
    "near",
    "antialiased",
)


@pytest.mark.parametrize(
    "kernel, mean_square",
    [
        ("pixel", 1e-7),
        ("pixel-quadratic", 1e-8),
        ("pixel-small", 1e-7),
        ("pixel-quadratic-small", 1e-8),
        ("lens-column", 1e-8),
    ],
)
def test_frames_are_those_of_the_cpu(drawn, kernel, mean_square):
    for (name, degree, views), found in zip(cases.frames_of(kernel), drawn(kernel), strict=True):
        panel = cases.panel_of(name)
        expected = encode(
            cases.scene_of(degree),
            panel,
            cases.rig_of(panel),
            views=views,
            background=cases.BACKGROUND,
            output="float32",
        )
        error = (found["image"] - expected).abs()
        assert found["kernel"] == kernel and (error > 1 / 255).sum() <= 1, name
        assert kernel != "lens-column" or found["layout"] == "full"
        assert (error**2).mean() < mean_square, (name, degree, views)
        if name == "narrow cone" and "quadratic" in kernel:  # both fits meet in a batch of hits
            assert 0.5 < found["curved"] < 0.8


def mean_error_of_piece(image: torch.Tensor) -> float:
    """Of a frame of harmonic_piece, against the oracle. A byte is off by one with a chance of 255 times the error: 80
    dB are a mean error of 255 * 1e-8."""
    scene, panel, rig = cases.harmonic_piece()
    where = [axis.ravel() for axis in np.indices(image.shape)]
    expected = reference.subpixel_colours(scene, panel, rig, *where, background=cases.BACKGROUND)
    return np.abs(image.numpy().ravel() - expected).mean()


def test_half_of_100_kb_of_shared_memory_draws_as_exactly(drawn):
    *frames, antialiased, piece = drawn("compact")
    assert all(
        found["kernel"] == "lens-column" and found["layout"] == "compact" for found in (*frames, antialiased, piece)
    )
    for (name, degree, views), floats, bytes_ in zip(cases.COMPACT_FRAMES, frames[::2], frames[1::2], strict=True):
        panel = cases.panel_of(name)
        options = dict(views=views, background=cases.BACKGROUND, output="float32")
        expected = encode(cases.scene_of(degree), panel, cases.rig_of(panel), **options)
        error = (floats["image"] - expected).abs()
        assert (error > 1 / 255).sum() <= 1 and (error**2).mean() < 1e-8, name
        assert torch.equal(bytes_["image"], (255 * floats["image"].clamp(0, 1)).round().to(torch.uint8)), name
    assert mean_error_of_piece(piece["image"]) < 255e-8
    name, degree, views = cases.COMPACT_ANTIALIASED[1:4]
    panel, where = cases.panel_of(name), [axis.ravel() for axis in np.indices(antialiased["image"].shape)]
    options = dict(continuous=views == "continuous", background=cases.BACKGROUND, antialiased=True)
    oracle = reference.subpixel_colours(cases.fine(degree), panel, cases.rig_of(panel), *where, **options)
    assert ((antialiased["image"].numpy().ravel() - oracle) ** 2).mean() < 1e-8


def test_shapes_without_a_good_polynomial_are_evaluated_as_they_are(drawn):
    for (kernel, case), found in zip(cases.SHAPES_THAT_VARY, drawn("shapes"), strict=True):
        expected = encode(*case(), background=cases.BACKGROUND, output="float32")
        assert found["kernel"] == kernel and not found["exact"]  # of the frame: single splats are
        assert (found["image"] - expected).abs().max() < 0.4 / 255, kernel


def test_shapes_that_vary_within_a_lens_column_are_evaluated_as_they_are(drawn):
    assert set(drawn("chosen")) == {"lens-column"}
    for (kernel, views, changes), found in zip(cases.WIDEST, drawn("widest"), strict=True):
        expected = encode(*cases.widest(changes), background=cases.BACKGROUND, output="float32", views=views)
        error = (found["image"] - expected).abs()
        if kernel is None:  # so much varies that frames choose other kernels
            assert found["kernel"] != "lens-column" and error.max() < 0.4 / 255, changes
            continue
        # Some alphas are on the cut
        assert (error > 1 / 255).float().mean() < 1e-3 and error.max() < 1.5 / 255, (changes, views)
        assert found["kernel"] == kernel and error.mean() < 1.2e-4, (changes, views)


def test_half_precision_is_within_its_bound(drawn):
    for (kernel, changes, degree, views, brightness), found in zip(cases.HALF_FRAMES, drawn("half"), strict=True):
        scene, panel, rig = cases.half_frame(changes, degree, brightness)
        expected = encode(scene, panel, rig, views=views, background=cases.BACKGROUND, output="float32")
        error = (found["image"] - expected).abs() / expected.clamp(min=1)
        assert found["kernel"] == kernel and 2e-4 < error.max() <= cases.HALF_MOST, kernel
        assert (error**2).mean() < cases.HALF_MEAN_SQUARE, (kernel, degree)


def test_a_frame_with_other_places_type_or_colour_order(drawn):
    for frame, roomier, bytes_, coarser in drawn("settings"):
        assert torch.equal(roomier["image"], frame["image"])
        assert torch.equal(bytes_["image"], (255 * frame["image"].clamp(0, 1)).round().to(torch.uint8))
        # What a polynomial errs by at most: the bounds of both frames
        allowed = sum(f["colour_error"] for f in (frame, coarser))
        assert 0 < (coarser["image"] - frame["image"]).abs().max() <= min(allowed, 1 / 1000)


def test_parabolas_of_colours_are_within_their_bound(drawn):
    bounds = []
    for (kernel, cone_deg), (parabola, finer) in zip(cases.PARABOLAS, drawn("parabolas"), strict=True):
        panel = replace(cases.panel_of("default"), cone_deg=cone_deg)
        expected = encode(cases.scene_of(3), panel, cases.rig_of(panel), background=cases.BACKGROUND, output="float32")
        assert parabola["kernel"] == kernel
        assert ((parabola["image"] - expected) ** 2).mean() < 1e-8, kernel
        bounds.append(parabola["colour_error"])
        assert (parabola["image"] - finer["image"]).abs().max() < bounds[-1] + 1e-5, kernel
    # The bound is of third order in the cone, but for what splats leave out to have fewer powers
    left_out = frame_cuda._COLOUR_LEFT_OUT
    assert bounds[0] == bounds[1] and bounds[2] == bounds[3] and bounds[0] > 0
    assert 7 * (bounds[0] - left_out) < bounds[2] < 9 * bounds[0] and 9 * bounds[2] < 1e-2


def test_colours_near_the_cameras_are_exact(drawn):
    for nearest, found in zip(cases.NEAR, drawn("near"), strict=True):
        expected = encode(*cases.near(nearest), "sorted", background=cases.BACKGROUND, output="float32")
        assert (found["image"] - expected).abs().max() < 0.5 / 255, nearest
        # By lens columns colours would be parabolas within each
        assert found["kernel"] != "lens-column" and found["bent_colours"] > 0 and found["colour_error"] < 2e-4


def test_harmonics_of_a_wide_cone_keep_80_db(drawn):
    assert mean_error_of_piece(drawn("harmonics")["image"]) < 255e-8


def test_antialiased_frames_are_those_of_the_oracle(drawn):
    for (kernel, name, degree, views, quality), found in zip(cases.ANTIALIASED, drawn("antialiased"), strict=True):
        panel, scene = cases.panel_of(name), cases.fine(degree)
        rig, where = cases.rig_of(panel), [axis.ravel() for axis in np.indices(found["image"].shape)]
        expected = reference.subpixel_colours(
            scene, panel, rig, *where, continuous=views == "continuous", background=cases.BACKGROUND, antialiased=True
        )
        error = np.abs(found["image"].numpy().ravel() - expected)
        assert found["kernel"] == kernel or kernel is None and found["kernel"].startswith("pixel-quadratic")
        assert (error**2).mean() < (1e-8 if quality == "exact" else 5e-4), name
        plain = encode(scene, panel, rig, views=views, background=cases.BACKGROUND, output="float32")
        assert ((plain.numpy().ravel() - expected) ** 2).mean() > 1e-3
