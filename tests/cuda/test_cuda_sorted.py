"""The method `sorted` on CUDA against the CPU and against the other methods. Needs a GPU."""

from __future__ import annotations

import gc
import re

import numpy as np
import pytest
import torch
from rasterizer_cases import hard_scene, panel, random_scene, rig
from sorted_cases import oracle, random_map, toe_in

from lightfield_gs import Gaussians, InputError, SortedPlan, _core, encode
from lightfield_gs.bench.scenes import cloud, sheet
from lightfield_gs.encoding.sorted import CudaStages
from lightfield_gs.rasterizer.workspace import SceneTensors

if not (torch.cuda.is_available() and hasattr(_core, "cuda")):
    pytest.skip("needs a CUDA device and a build with LFGS_CUDA", allow_module_level=True)

BACKGROUND = (0.1, 0.6, 0.3)


def sorted_image(scene, shown, cameras=None, table=None, rig=None, output="float32", **options):
    return encode(
        scene, shown, rig, "sorted", cameras=cameras, view_map=table, background=BACKGROUND, output=output, **options
    )


def far_apart(a: torch.Tensor, b: torch.Tensor) -> int:
    """How many samples differ by more than 1/255: only those that sit on a threshold may."""
    return int(((a.cpu().double() - b.cpu().double()).abs() > 1 / 255).sum())


@pytest.fixture(params=[0, 1, 3])
def scene(request) -> Gaussians:
    return random_scene(2000, request.param, seed=request.param, size=0.03).to(torch.float32)


@pytest.mark.parametrize("views, size", [(1, (33, 21)), (9, (397, 131)), (96, (640, 200)), (3000, (301, 77))])
def test_any_cameras_and_any_map_are_those_of_the_cpu(scene, views, size):
    shown = panel(width_px=size[0], height_px=size[1], views=views)
    cameras, table = toe_in(shown, views), random_map(shown, views, 1)
    expected, found = (sorted_image(s, shown, cameras, table) for s in (scene, scene.to("cuda")))
    assert found.is_cuda and far_apart(expected, found) <= 3
    assert (expected - found.cpu()).abs().mean() < 1e-6
    bytes8 = sorted_image(scene.to("cuda"), shown, cameras, table, output="uint8")
    assert torch.equal(bytes8, (255 * found.clamp(0, 1)).round().to(torch.uint8))  # ties to even, both


@pytest.mark.parametrize("kind", ["clamped", "needles", "huge", "opaque", "specks", "near and far", "equal depths"])
def test_gaussians_that_are_hard(kind):
    shown, scene = panel(width_px=90, height_px=50), hard_scene(kind, 40, seed=3)
    cameras, table = toe_in(shown, 12), random_map(shown, 12, 5)
    want, margin = oracle(scene, cameras, table, BACKGROUND)
    found = sorted_image(scene.to("cuda", torch.float32), shown, cameras, table).cpu().numpy()
    assert np.abs(found - want)[margin > 5e-3].max() < 2e-3


@pytest.mark.parametrize("views", ["integer", "continuous"])
@pytest.mark.parametrize(
    "name",
    [
        "default lens",
        "leaning the other way, BGR",
        "inverted",
        "one view",
        "one pixel",
        "narrower than a pixel",
        "lenses as wide as the panel",
    ],
)
def test_the_rig_and_the_lens_of_a_panel(name, views):
    shown, scene = panel(name), sheet(48, 11)
    expected, found = (sorted_image(s, shown, rig=rig(shown, 0.1), views=views) for s in (scene, scene.to("cuda")))
    assert far_apart(expected, found) <= 3


def test_the_same_picture_as_the_other_methods():
    shown, scene = panel(width_px=480, height_px=240), cloud(8000).to("cuda")
    images = [encode(scene, shown, rig(shown), method, output="float32") for method in ("sorted", "classic", "direct")]
    assert far_apart(images[0], images[1]) <= 3 and far_apart(images[0], images[2]) <= 1e-5 * images[0].numel() + 3


def test_all_subpixels_of_one_view_fill_many_blocks():
    shown, scene = panel(width_px=300, height_px=90), random_scene(3000, 1, seed=8, size=0.05).to(torch.float32)
    cameras, table = toe_in(shown, 96), np.full((90, 300, 3), 95, np.int32)
    expected, found = (sorted_image(s, shown, cameras, table) for s in (scene, scene.to("cuda")))
    assert far_apart(expected, found) <= 3


@pytest.mark.parametrize("count", [0, 1])
def test_few_gaussians(count):
    scene = Gaussians(*(field[:count] for field in sheet(48, 11).fields().values()))
    shown = panel()
    expected, found = (sorted_image(s, shown, rig=rig(shown), output="uint8") for s in (scene, scene.to("cuda")))
    assert (expected.int() - found.cpu().int()).abs().max() <= 1


def test_what_shows_nothing_is_background(scene):
    shown = panel()
    table = np.full((shown.height_px, shown.width_px, 3), -1, np.int32)
    image = sorted_image(scene.to("cuda"), shown, toe_in(shown, 3), table)
    assert torch.equal(image.cpu(), torch.tensor(BACKGROUND).expand_as(image))


def within(budget: int | None) -> tuple[int, torch.Tensor, dict]:
    """A frame of 96 cameras: what torch's allocator was asked for at most, beside the image; the image; the stats."""
    shown = panel(width_px=1600, height_px=700)
    scene = random_scene(20_000, 1, seed=2, size=0.02).to("cuda", torch.float32)
    cameras, plan, stats = toe_in(shown, 96), SortedPlan(shown, device="cuda"), {}
    gc.collect()  # what others left must not go between the two readings
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_stats()["requested_bytes.all.current"]
    image = sorted_image(scene, shown, cameras, plan, output="uint8", memory_budget=budget, stats=stats)
    return torch.cuda.memory_stats()["requested_bytes.all.peak"] - before - image.numel(), image, stats


@pytest.fixture(scope="module")
def unbounded():
    """The image of a frame without a budget, and the bytes of its work memory in one piece."""
    _, image, stats = within(None)
    return image, sum(stats["memory_bytes_unchunked"].values())


@pytest.mark.parametrize("share", [1, 2, 4, 16])
def test_any_budget_gives_the_same_bits_and_is_kept(unbounded, share):
    whole, total = unbounded
    used, image, stats = within(total // share)
    assert torch.equal(image, whole)
    assert used <= total // share and sum(stats["memory_bytes"].values()) <= total // share


def test_the_least_budget_that_the_error_names_is_enough(unbounded):
    with pytest.raises(InputError, match="memory budget of 1000 bytes") as error:
        within(1000)
    least = int(re.search(r"need (\d+) bytes", str(error.value))[1])
    used, image, _ = within(least)
    assert torch.equal(image, unbounded[0]) and used <= least


def test_the_same_bits_in_every_run(scene):
    shown = panel(width_px=200, height_px=80)
    cameras, plan = toe_in(shown, 96), SortedPlan(panel(width_px=200, height_px=80), device="cuda")
    images = [sorted_image(scene.to("cuda"), shown, cameras, plan) for _ in range(3)]
    assert torch.equal(images[0], images[1]) and torch.equal(images[0], images[2])


def test_a_plan_for_the_cpu_is_refused(scene):
    shown = panel()
    with pytest.raises(InputError, match="device='cuda'"):
        sorted_image(scene.to("cuda"), shown, toe_in(shown, 96), SortedPlan(shown))


def test_more_pairs_than_a_chunk_may_have_are_estimated(scene):
    shown = panel(width_px=160, height_px=70, views=8)
    stages = CudaStages(
        SceneTensors(*(t[None] for t in scene.to("cuda").fields().values())), SortedPlan(shown, device="cuda")
    )
    few, many = (stages.binning_bytes(8, (pairs, 0)) for pairs in (1 << 31, 1 << 33))
    assert 3.9 * few < many < 4.1 * few
