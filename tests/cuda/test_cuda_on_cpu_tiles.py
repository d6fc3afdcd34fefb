"""Tiles of the CUDA stages, compiled for the CPU: their lattices, their lists, and what is left out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from cuda_on_cpu import cases
from cuda_on_cpu.drawings import EMULATED

from lightfield_gs import Quality, encode, reference
from lightfield_gs.base.harmonics import SH_CONSTANT

pytestmark = EMULATED

DRAWN = ("memory", "lattice", "words", "half empty", "opaque", "crowd", "pruned", "recoloured", "sorted")


def test_a_work_buffer_takes_what_the_documents_say(drawn):
    empty, gaussians, with_pairs, only_pairs, harmonics = drawn("memory")
    lens_columns = 12  # of the default panel, in whole groups
    tolerance = 2000  # parts begin at multiples of 256 bytes
    assert empty < 1e6
    assert abs((gaussians - empty) - 1e6 * (48 + 16 + 4 + 4)) < tolerance  # splat, colour, depth, place in a list
    assert abs((with_pairs - gaussians) - 1e6 * 4 * (26 - 1)) < tolerance
    assert abs((harmonics - only_pairs) - 1e6 * (48 + 16 * 9 + 4 + 4 + 24 * lens_columns)) < tolerance


@pytest.fixture(scope="module")
def lattice_frames(drawn) -> list[dict[str, Any]]:
    return drawn("lattice")


def test_what_is_smooth_is_drawn_from_a_lattice(lattice_frames):
    *found, harmonic, crowded, bytes_, _, _ = lattice_frames
    cases_ = [*((case, 0) for case in cases.LATTICE_FRAMES), (cases.LATTICE_FRAMES[0], 1)]
    for ((kernel, quality, views, changes), degree), frame in zip(cases_, [*found, harmonic], strict=True):
        scene, panel, rig = cases.lattice_frame(changes, degree)
        options = dict(views=views, background=cases.BACKGROUND)
        exact = encode(scene, panel, rig, output="float32", **options).clamp(0, 1)
        error = (frame["image"].clamp(0, 1) - exact).abs()
        assert frame["kernel"] == kernel and min(frame["lattice_tiles"], frame["refused_tiles"]) >= 2
        assert frame["tried_tiles"] == frame["lattice_tiles"] + frame["refused_tiles"]  # worth it, and none is empty
        assert (error**2).mean() < {"high": 1e-5, "fast": 1e-4}[quality], (kernel, quality)  # 50 and 40 dB
        # Smooth on the left, where nothing but the lattice and the stop err
        left, allowed = error[:, :64].max(), Quality.of(quality).lattice_error
        assert 1e-4 < left <= 2 * allowed, (kernel, quality)
    # Without lists everything is left to the kernel; bytes are the rounded floats, but for how ties are rounded
    assert crowded["lattice_tiles"] == 0 and crowded["refused_tiles"] > 0
    assert ((255 * found[0]["image"].clamp(0, 1)).round() - bytes_["image"]).abs().sum() <= 3


def test_bytes_of_a_lattice_are_its_colours_rounded_where_four_are_stored_at_a_time(drawn):
    frames = iter(drawn("words"))
    for changes in cases.WORDS:
        floats, bytes_ = next(frames), next(frames)
        assert floats["lattice_tiles"] >= 2 and floats["lattice_tiles"] == bytes_["lattice_tiles"]
        assert ((255 * floats["image"].clamp(0, 1)).round() - bytes_["image"]).abs().sum() <= 3
        expected = encode(*cases.lattice_frame(changes, 0), background=cases.BACKGROUND, output="float32")
        assert ((floats["image"].clamp(0, 1) - expected.clamp(0, 1)) ** 2).mean() < 1e-4  # 40 dB


def test_tiles_with_nothing_in_them_are_background(drawn):
    frames = iter(drawn("half empty"))
    for kernel, quality, views, changes in cases.LATTICE_FRAMES:
        scene, panel, rig = cases.half_empty(changes)
        expected = encode(
            scene, panel, rig, views=views, background=cases.BACKGROUND, output="float32", quality=quality
        )
        floats, bytes_ = next(frames), next(frames)
        right, background = slice(120, None), torch.tensor(cases.BACKGROUND)
        assert (floats["image"][:, right] - background).abs().max() < 1e-3, kernel
        assert (bytes_["image"][:, right] - 255 * background).abs().max() <= 0.5 + 1e-3 * 255, kernel
        assert (floats["image"].clamp(0, 1) - expected.clamp(0, 1)).abs().max() < 4 * Quality.of(quality).lattice_error
        drawn_tiles = floats["lattice_tiles"] + floats["refused_tiles"]
        assert 2 <= drawn_tiles <= (-(-120 // 64) * -(-71 // 32) if kernel != "lens-column" else 8)


def test_where_no_lattice_fits_few_are_tried(lattice_frames):
    rough, small = lattice_frames[-2:]
    _, panel, _ = cases.speckled()
    across, down = (-(-size // side) for size, side in ((panel.width_px, 64), (panel.height_px, 32)))
    assert rough["tried_tiles"] <= across < rough["refused_tiles"] == across * down  # of the first row of tiles alone
    assert small["tried_tiles"] == small["refused_tiles"] == small["lattice_tiles"] == 0  # all at once
    cut = cases.WIDE_QUALITY.opacity_cut
    for frame, (scene, panel, rig) in ((rough, cases.speckled()), (small, cases.wide_rig())):
        exact = encode(
            scene, panel, rig, background=cases.BACKGROUND, quality=Quality(opacity_cut=cut), output="float32"
        )
        error = (frame["image"] - exact).abs()
        assert (error**2).mean() < 1e-7 and error.max() <= cut  # what an alpha on the cut adds or leaves


def test_a_sample_that_ends_leaves_its_rest_to_the_background(drawn):
    for (kernel, name), frame in zip(cases.OPAQUE_FRAMES, drawn("opaque"), strict=True):
        scene, panel, rig = cases.opaque(name)
        where = [axis.ravel() for axis in np.indices((panel.height_px, panel.width_px, 3))]
        expected = reference.subpixel_colours(scene, panel, rig, *where, background=cases.BACKGROUND)
        ended = np.abs(expected - (0.5 + SH_CONSTANT * scene.sh[0, 0, 0].item())) < 3e-4  # nothing else shows of others
        # The transmittance left is 1e-4 or little more. Drawn to the end, these samples would err by it times the
        # contrast
        assert ended.mean() > 0.3 and np.abs(frame["image"].numpy().ravel() - expected)[ended].mean() < 1e-5, kernel


def test_lists_of_any_length_are_in_order(drawn):
    scene, panel, rig = cases.crowd()
    expected = encode(scene, panel, rig, background=cases.BACKGROUND, output="float32")
    reverse = [field.flip(0) for field in scene.fields().values()]
    swapped = encode(type(scene)(*reverse), panel, rig, background=cases.BACKGROUND, output="float32")
    assert ((swapped - expected) ** 2).mean() > 1e-6  # it shows in which order those of one depth are
    listed, walked = drawn("crowd")
    # More than are sorted at a time
    assert cases.CROWD + 600 < listed["intersections"] == walked["intersections"] < 2 * cases.CROWD
    for frame in (listed, walked):
        assert ((frame["image"] - expected) ** 2).mean() < 1e-8 and frame["drawn"] == cases.CROWD


def test_a_lattice_is_within_its_bound_of_the_oracle(lattice_frames):
    (_, quality, _, changes), image = cases.LATTICE_FRAMES[0], lattice_frames[0]["image"]
    scene, panel, rig = cases.lattice_frame(changes, 0)
    random = np.random.default_rng(5)
    where = [random.integers(0, size, 2000) for size in (panel.height_px, 128, 3)]
    colours = reference.subpixel_colours(scene, panel, rig, *where, background=cases.BACKGROUND)
    error = np.abs(image.numpy()[tuple(where)] - np.clip(colours, 0, 1))
    assert error.max() <= 2 * Quality.of(quality).lattice_error


def test_a_frame_is_pruned_as_on_the_cpu(drawn):
    found, panel, stats = drawn("pruned"), cases.panel_of("default"), {}
    scene = cases.scene_of(3)
    expected = encode(
        scene,
        panel,
        cases.rig_of(panel),
        background=cases.BACKGROUND,
        output="float32",
        quality=cases.PRUNING,
        stats=stats,
    )
    assert 0 < found["pruned"] == stats["skipped"]["gaussians"]["pruned"] < scene.count
    assert (
        found["drawn"] == scene.count - stats["gaussians_culled"] and ((found["image"] - expected) ** 2).mean() < 1e-7
    )


def test_a_frame_takes_other_colours_into_the_lists_it_has(drawn):
    for frames in drawn("recoloured"):
        image, expected = frames["found"].pop("image"), frames["expected"].pop("image")
        assert torch.equal(image, expected) and frames["found"] == frames["expected"]


def test_sorted_in_any_chunks_is_that_of_the_cpu(drawn):
    expected, _ = cases.sorted_frame(None)
    whole, *chunked = drawn("sorted")
    assert whole["memory_bytes"] == whole["memory_bytes_unchunked"]
    assert ((whole["image"] - expected).abs() > 1 / 255).sum() <= 1 and (whole["image"] - expected).abs().mean() < 1e-6
    for share, found in zip((1, 3, 9), chunked, strict=True):
        assert torch.equal(found["image"], whole["image"])
        assert found["memory_bytes"] < whole["memory_bytes"] / share
