"""The CUDA stages, compiled for the CPU (tests/cuda_on_cpu): the logic of their kernels is tested without a GPU."""

from __future__ import annotations

import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cuda_on_cpu import cases, crop_cases, fit_cases, sheet_cases, slot_cases, surface_cases

from lightfield_gs import Quality, encode, reference
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.rasterizer import frame_cuda
from lightfield_gs.rasterizer.quality import QUALITIES

FOLDER = Path(__file__).parents[1] / "cuda_on_cpu"
CSRC = FOLDER.parents[1] / "csrc"

if platform.machine() != "x86_64" or shutil.which("g++") is None or not Path("/usr/include/hwy").exists():
    pytest.skip("needs g++ on x86-64, and the packages of GLM and Highway", allow_module_level=True)
pybind11 = pytest.importorskip("pybind11")
pytestmark = [pytest.mark.slow, pytest.mark.long_file, pytest.mark.not_sanitized]


DRAWN = (
    "pixel",
    "pixel-quadratic",
    "pixel-small",
    "pixel-quadratic-small",
    "ordinal",
    "compact",
    "memory",
    "shapes",
    "chosen",
    "widest",
    "half",
    "settings",
    "parabolas",
    "lattice",
    "words",
    "half empty",
    "harmonics",
    "opaque",
    "crowd",
    "pruned",
    "recoloured",
    "dense",
    "rooms",
    "fit",
    "sorted",
    "gradients",
    "norms",
    "surface",
    "sheet",
    "crops",
    "antialiased",
    "antialiased gradients",
    "view filter",
)


class Drawer:
    """A draw.py that runs, and draws one thing after the other."""

    def __init__(self, module: str, folder: Path):
        command = [sys.executable, FOLDER / "draw.py", module, folder]
        self.folder = folder
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __call__(self, what: str) -> Any:
        print(what, file=self.process.stdin, flush=True)
        code = self.process.stdout.readline().strip()
        assert code == "0", f"{code}: {(self.folder / f'{what}.log').read_text()[-2000:]}"
        return torch.load(self.folder / f"{what}.pt", weights_only=True)

    def end(self) -> None:
        self.process.stdin.close()
        self.process.wait()


class Drawings:
    """What is drawn by two at a time: by one all of it from the last on, while tests ask for it from the first on and
    have the other draw what has not begun."""

    def __init__(self, module: str, folder: Path):
        self.asked, self.ahead = (Drawer(module, folder) for _ in range(2))
        self.pool = ThreadPoolExecutor(1)
        self.begun = {what: self.pool.submit(self.ahead, what) for what in reversed(DRAWN)}

    def __call__(self, what: str) -> Any:
        return self.asked(what) if self.begun[what].cancel() else self.begun[what].result()

    def end(self) -> None:
        self.pool.shutdown(cancel_futures=True)
        self.asked.end(), self.ahead.end()


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> Iterator[Drawings]:
    """By the native module with emulated CUDA stages."""
    out = tmp_path_factory.mktemp("cuda_on_cpu")
    built = subprocess.run(
        [sys.executable, FOLDER / "build.py", CSRC, out, pybind11.get_include()],
        check=True,
        capture_output=True,
        text=True,
    )
    drawings = Drawings(built.stdout.strip(), out)
    yield drawings
    drawings.end()


@pytest.mark.parametrize(
    "kernel, mean_square",
    [
        ("pixel", 1e-7),
        ("pixel-quadratic", 1e-8),
        ("pixel-small", 1e-7),
        ("pixel-quadratic-small", 1e-8),
        ("ordinal", 1e-8),
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
        assert kernel != "ordinal" or found["layout"] == "full"
        assert (error**2).mean() < mean_square, (name, degree, views)
        if name == "narrow cone" and "quadratic" in kernel:  # both fits meet in a batch of hits
            assert 0.5 < found["curved"] < 0.8


def test_half_of_100_kb_of_shared_memory_draws_as_exactly(drawn):
    *frames, antialiased, piece = drawn("compact")
    assert all(found["kernel"] == "ordinal" and found["layout"] == "compact" for found in (*frames, antialiased, piece))
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


def test_a_work_buffer_takes_what_the_documents_say(drawn):
    empty, gaussians, with_pairs, only_pairs, harmonics = drawn("memory")
    ordinals = 12  # of the default panel, in whole groups
    tolerance = 2000  # parts begin at multiples of 256 bytes
    assert empty < 1e6
    assert abs((gaussians - empty) - 1e6 * (48 + 16 + 4 + 4)) < tolerance  # splat, colour, depth, place in a list
    assert abs((with_pairs - gaussians) - 1e6 * 4 * (26 - 1)) < tolerance
    assert abs((harmonics - only_pairs) - 1e6 * (48 + 16 * 9 + 4 + 4 + 24 * ordinals)) < tolerance


def test_shapes_without_a_good_polynomial_are_evaluated_as_they_are(drawn):
    for (kernel, case), found in zip(cases.SHAPES_THAT_VARY, drawn("shapes"), strict=True):
        expected = encode(*case(), background=cases.BACKGROUND, output="float32")
        assert found["kernel"] == kernel and not found["exact"]  # of the frame: single splats are
        assert (found["image"] - expected).abs().max() < 0.4 / 255, kernel


def test_shapes_that_vary_within_an_ordinal_are_evaluated_as_they_are(drawn):
    assert set(drawn("chosen")) == {"ordinal"}
    for (kernel, views, changes), found in zip(cases.WIDEST, drawn("widest"), strict=True):
        expected = encode(*cases.widest(changes), background=cases.BACKGROUND, output="float32", views=views)
        error = (found["image"] - expected).abs()
        if kernel is None:  # so much varies that frames choose other kernels
            assert found["kernel"] != "ordinal" and error.max() < 0.4 / 255, changes
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
    for frame, roomier, bytes_, finer in drawn("settings"):
        assert torch.equal(roomier["image"], frame["image"])
        assert torch.equal(bytes_["image"], (255 * frame["image"].clamp(0, 1)).round().to(torch.uint8))
        # What a polynomial errs by at most: the estimate of the frame, and the powers left out
        allowed = sum(f["colour_error"] + frame_cuda._COLOUR_TOLERANCE for f in (frame, finer))
        assert 0 < (finer["image"] - frame["image"]).abs().max() <= allowed < 1 / 1000


def test_parabolas_of_colours_are_within_their_bound(drawn):
    bounds = []
    for (kernel, cone_deg), (parabola, finer) in zip(cases.PARABOLAS, drawn("parabolas"), strict=True):
        panel = replace(cases.panel_of("default"), cone_deg=cone_deg)
        expected = encode(cases.scene_of(3), panel, cases.rig_of(panel), background=cases.BACKGROUND, output="float32")
        assert parabola["kernel"] == kernel
        assert ((parabola["image"] - expected) ** 2).mean() < 1e-8, kernel
        bounds.append(parabola["colour_error"])
        assert (parabola["image"] - finer["image"]).abs().max() < bounds[-1] + 1e-5, kernel
    # The bound is of third order in the cone
    assert bounds[0] == bounds[1] and 0 < 7 * bounds[0] < bounds[2] == bounds[3] < 9 * bounds[0] < 1e-2


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
        left, allowed = error[:, :64].max(), QUALITIES[quality].lattice_error
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
        assert (floats["image"].clamp(0, 1) - expected.clamp(0, 1)).abs().max() < 4 * QUALITIES[quality].lattice_error
        drawn_tiles = floats["lattice_tiles"] + floats["refused_tiles"]
        assert 2 <= drawn_tiles <= (-(-120 // 64) * -(-71 // 32) if kernel != "ordinal" else 8)


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


def mean_error_of_piece(image: torch.Tensor) -> float:
    """Of a frame of harmonic_piece, against the oracle. A byte is off by one with a chance of 255 times the error: 80
    dB are a mean error of 255 * 1e-8."""
    scene, panel, rig = cases.harmonic_piece()
    where = [axis.ravel() for axis in np.indices(image.shape)]
    expected = reference.subpixel_colours(scene, panel, rig, *where, background=cases.BACKGROUND)
    return np.abs(image.numpy().ravel() - expected).mean()


def test_harmonics_of_a_wide_cone_keep_80_db(drawn):
    assert mean_error_of_piece(drawn("harmonics")["image"]) < 255e-8


def test_a_sample_that_ends_leaves_its_rest_to_the_background(drawn):
    for (kernel, name), frame in zip(cases.OPAQUE_FRAMES, drawn("opaque"), strict=True):
        scene, panel, rig = cases.opaque(name)
        where = [axis.ravel() for axis in np.indices((panel.height_px, panel.width_px, 3))]
        expected = reference.subpixel_colours(scene, panel, rig, *where, background=cases.BACKGROUND)
        ended = np.abs(expected - (0.5 + SH_CONSTANT * scene.sh[0, 0, 0].item())) < 3e-4  # nothing else shows of others
        # What is left is 1e-4 or little more; drawn to the end, these would be off by that times the contrast
        assert ended.mean() > 0.3 and np.abs(frame["image"].numpy().ravel() - expected)[ended].mean() < 1e-5, kernel


def test_lists_of_any_length_are_in_order(drawn):
    scene, panel, rig = cases.crowd()
    expected = encode(scene, panel, rig, background=cases.BACKGROUND, output="float32")
    reverse = [field.flip(0) for field in scene.fields().values()]
    swapped = encode(type(scene)(*reverse), panel, rig, background=cases.BACKGROUND, output="float32")
    assert ((swapped - expected) ** 2).mean() > 1e-6  # it shows in which order those of one depth are
    listed, walked = drawn("crowd")
    assert cases.CROWD + 600 < listed["pairs"] == walked["pairs"] < 2 * cases.CROWD  # more than are sorted at a time
    for frame in (listed, walked):
        assert ((frame["image"] - expected) ** 2).mean() < 1e-8 and frame["drawn"] == cases.CROWD


def test_a_lattice_is_within_its_bound_of_the_oracle(lattice_frames):
    (_, quality, _, changes), image = cases.LATTICE_FRAMES[0], lattice_frames[0]["image"]
    scene, panel, rig = cases.lattice_frame(changes, 0)
    random = np.random.default_rng(5)
    where = [random.integers(0, size, 2000) for size in (panel.height_px, 128, 3)]
    colours = reference.subpixel_colours(scene, panel, rig, *where, background=cases.BACKGROUND)
    error = np.abs(image.numpy()[tuple(where)] - np.clip(colours, 0, 1))
    assert error.max() <= 2 * QUALITIES[quality].lattice_error


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


def test_images_and_gradients_are_those_of_float64(drawn):
    found = drawn("dense")
    for name, expected in cases.dense_step(torch.float64).items():
        error = (found[name].double() - expected).norm() / expected.norm()
        assert error < (1e-5 if name in ("image", "alpha", "depth") else 1e-3), name


def test_splats_that_fill_images_and_room_for_pairs(drawn):
    """Slots that a block adds up together; and with too little room nothing but the images is wrong, which is said."""
    found, expected = drawn("rooms"), slot_cases.images_and_gradients(torch.float64)[0]
    for name, right in expected.items():
        error = (found["waited"][name].double() - right).norm() / right.norm()
        assert error < (1e-5 if name in ("image", "alpha", "depth") else 1e-3), name
        assert torch.equal(found["enough"][name], found["waited"][name]), name
    assert found["pairs"] > slot_cases.SCENES * slot_cases.VIEWS * 4 * 256
    for short in found["short"]:
        assert short["pairs"] == found["pairs"] and short["buffers"] > 10 and short["intact"]


def test_sorted_in_any_chunks_is_that_of_the_cpu(drawn):
    expected, _ = cases.sorted_frame(None)
    whole, *chunked = drawn("sorted")
    assert whole["memory_bytes"] == whole["memory_bytes_unchunked"]
    assert ((whole["image"] - expected).abs() > 1 / 255).sum() <= 1 and (whole["image"] - expected).abs().mean() < 1e-6
    for share, found in zip((1, 3, 9), chunked, strict=True):
        assert torch.equal(found["image"], whole["image"])
        assert found["memory_bytes"] < whole["memory_bytes"] / share


def test_gradients_of_long_needles_and_short_quaternions_are_those_of_float64(drawn):
    largest = torch.finfo(torch.float32).max
    for (scene, sensor), found in zip(cases.HARD_GRADIENTS, drawn("gradients"), strict=True):
        for name, expected in cases.gradients(scene(), sensor, torch.float64).items():
            held = expected.clamp(-largest, largest)
            assert (found[name].double() - held).norm() < 5e-3 * held.norm(), (scene.__name__, sensor, name)


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


def test_antialiased_images_and_gradients_are_those_of_float64(drawn):
    found = iter(drawn("antialiased gradients"))
    for scene in (cases.fine(1), cases.beams()):
        for sensor in ("lens", "dense"):
            have = next(found)
            for name, expected in cases.gradients(scene, sensor, torch.float64, antialiased=True).items():
                error = (have[name].double() - expected).norm() / expected.norm()
                assert error < (1e-5 if name == "image" else 5e-3), (sensor, name)


def test_filtered_views_and_their_gradients_are_those_of_the_oracle(drawn):
    *images, gradients = drawn("view filter")
    for (kernel, name, degree, views, _), found in zip(cases.FILTERED, images, strict=True):
        panel, scene = cases.panel_of(name), cases.fine(degree)
        rig, where = cases.rig_of(panel), [axis.ravel() for axis in np.indices(found["image"].shape)]
        options = dict(continuous=views == "continuous", background=cases.BACKGROUND, view_filter=cases.VIEW_FILTER)
        expected = reference.subpixel_colours(scene, panel, rig, *where, **options)
        assert found["kernel"] == kernel
        assert ((found["image"].numpy().ravel() - expected) ** 2).mean() < 1e-8, name
    expected = cases.gradients(cases.fine(1), "lens", torch.float64, view_filter=cases.VIEW_FILTER)
    for name, value in expected.items():
        error = (gradients[name].double() - value).norm() / value.norm()
        assert error < (1e-5 if name == "image" else 5e-3), name


def test_group_norm_and_silu(drawn):
    for case, found in zip(cases.NORMS, drawn("norms"), strict=True):
        expected = cases.norm_expected(*cases.norm_case(*case))
        assert found.dtype == torch.bfloat16 and found.is_contiguous(memory_format=torch.channels_last)
        torch.testing.assert_close(found.double(), expected, rtol=2**-8, atol=2e-5)


def test_fitting_is_that_of_the_cpu(drawn):
    fit_cases.compare(drawn("fit"))


def test_the_surface_of_a_photos_sheet_is_that_of_pytorch(drawn):
    for case, found in zip(surface_cases.CASES, drawn("surface"), strict=True):
        surface_cases.compare(case, found)


def test_the_sheet_over_a_photo_is_that_of_pytorch(drawn):
    for case, found in zip(sheet_cases.CASES, drawn("sheet"), strict=True):
        sheet_cases.compare(case, found)


def test_photos_are_cropped_as_on_the_host(drawn):
    crop_cases.compare(*drawn("crops"))
