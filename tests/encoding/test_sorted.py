"""The method `sorted`: any cameras and any view map against the oracle, the plan, the memory budget, bad input."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from rasterizer_cases import PANELS, all_subpixels, hard_scene, panel, random_scene, rig
from sorted_cases import oracle, random_map, toe_in

from lightfield_gs import Cameras, InputError, Panel, SortedPlan, _core, encode, reference
from lightfield_gs.encoding.sorted_plan import BLOCK

BACKGROUND = (0.1, 0.6, 0.3)
SETTLED = 2e-3  # samples whose decisions came nearer to a threshold than this may differ in float32


def sorted_image(scene, shown, cameras=None, table=None, rig=None, output="float64", **options):
    return encode(
        scene, shown, rig, "sorted", cameras=cameras, view_map=table, background=BACKGROUND, output=output, **options
    )


# Against the oracle


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("count, seed", [(1, 1), (9, 2), (150, 3)])
def test_any_cameras_and_any_map(count, seed, degree):
    shown, scene = panel(width_px=51, height_px=39), random_scene(50, degree, seed=seed)
    cameras, table = toe_in(shown, count), random_map(shown, count, seed)
    want, margin = oracle(scene, cameras, table, BACKGROUND)
    exact = sorted_image(scene, shown, cameras, table).numpy()
    assert np.abs(exact - want)[margin > 1e-9].max() < 1e-9
    single = sorted_image(scene.to(torch.float32), shown, cameras, table, output="float32").numpy()
    assert np.abs(single - want)[margin > SETTLED].max() < 5e-4
    bytes8 = sorted_image(scene.to(torch.float32), shown, cameras, table, output="uint8").numpy()
    assert np.abs(255 * single.clip(0, 1) - bytes8).max() <= 0.5 + 1e-4


@pytest.mark.parametrize("views", ["integer", "continuous"])
@pytest.mark.parametrize("name", PANELS)
def test_unusual_panels_with_their_rig(name, views):
    shown, scene = panel(name), random_scene(40, 1, seed=len(name))
    fan = rig(shown, 0.1, -0.15, (0.53, 0.44))
    some = [index[::7] for index in all_subpixels(shown)]
    want, margin = reference.subpixel_colours(
        scene, shown, fan, *some, background=BACKGROUND, continuous=views == "continuous", return_margin=True
    )
    exact = sorted_image(scene, shown, rig=fan, views=views).numpy().ravel()[::7]
    assert np.abs(exact - want)[margin > 1e-7].max() < 1e-7


@pytest.mark.parametrize("kind", ["clamped", "needles", "huge", "opaque", "specks", "near and far", "equal depths"])
def test_gaussians_that_are_hard(kind):
    shown, scene = panel(width_px=70, height_px=36), hard_scene(kind, 40, seed=3)
    cameras, table = toe_in(shown, 12), random_map(shown, 12, 5)
    want, margin = oracle(scene, cameras, table, BACKGROUND)
    exact = sorted_image(scene, shown, cameras, table).numpy()
    assert np.abs(exact - want)[margin > 1e-7].max() < 1e-7
    single = sorted_image(scene.to(torch.float32), shown, cameras, table, output="float32").numpy()
    assert np.abs(single - want)[margin > 5e-3].max() < 2e-3


@pytest.mark.parametrize("target", _core.simd_targets())
def test_every_vector_set(target):
    shown, scene = panel(width_px=131, height_px=40), random_scene(50, 1, seed=6)
    cameras, table = toe_in(shown, 20), random_map(shown, 20, 6)
    want, margin = oracle(scene, cameras, table, BACKGROUND)
    _core.set_simd_target(target)
    try:
        single = sorted_image(scene.to(torch.float32), shown, cameras, table, output="float32").numpy()
    finally:
        _core.set_simd_target("")
    assert np.abs(single - want)[margin > SETTLED].max() < 5e-4


def test_all_subpixels_of_one_view_fill_many_batches():
    shown, scene = panel(width_px=70, height_px=40), random_scene(60, 1, seed=8)
    cameras, table = toe_in(shown, 96), np.full((40, 70, 3), 95, np.int32)
    want, margin = oracle(scene, cameras, table, BACKGROUND)
    assert np.abs(sorted_image(scene, shown, cameras, table).numpy() - want)[margin > 1e-9].max() < 1e-9


def test_a_map_with_the_rig_of_the_panel():
    shown, scene = panel(views=9), random_scene(40, 1, seed=9)
    fan, table = rig(shown, 0.1), random_map(panel(views=9), 9, 1)
    want, margin = oracle(scene, fan.cameras(shown), table, BACKGROUND)
    assert np.abs(sorted_image(scene, shown, table=table, rig=fan).numpy() - want)[margin > 1e-9].max() < 1e-9


@pytest.mark.parametrize("output", ["uint8", "float32", "float64"])
def test_what_shows_nothing_is_background(output):
    shown, scene = panel(), random_scene(40, seed=1)
    table = np.full((shown.height_px, shown.width_px, 3), -1, np.int32)
    hidden = sorted_image(scene, shown, toe_in(shown, 3), table, output=output)
    empty = scene.__class__(*(field[:0] for field in scene.fields().values()))
    nothing = sorted_image(empty, shown, toe_in(shown, shown.views), output=output)
    assert torch.equal(hidden, nothing)
    want = torch.tensor(BACKGROUND, dtype=torch.float64)
    want = (255 * want).round().to(torch.uint8) if output == "uint8" else want.to(hidden.dtype)
    assert torch.equal(hidden, want.expand_as(hidden))


# The plan


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("views, size", [(1, (33, 21)), (7, (70, 50)), (96, (640, 100)), (3000, (300, 70))])
def test_lists_hold_every_subpixel_once_in_order(views, size, device):
    shown = panel(views=views, width_px=size[0], height_px=size[1])
    table = random_map(shown, views, 3)
    plan = SortedPlan(shown, table, views, device)
    starts, codes = plan.lists(0, plan.count, torch.device("cpu"), False, 2)
    codes = codes.numpy().view(np.uint16)
    height, width = plan.tile.height_px, plan.tile.width_px
    assert (
        height & (height - 1) == 0
        and height * width <= 1 << 14
        and plan.tiles == -(-size[0] // width) * -(-size[1] // height)
    )
    assert np.array_equal(plan.shown, np.unique(table[table >= 0])) and plan.hidden == (table < 0).any()
    seen = np.full(table.shape, -1)
    bits = height.bit_length() - 1
    for index in range(plan.count * plan.tiles):
        mine = codes[starts[index] : starts[index + 1]]
        real = mine[mine != 0xFFFF].astype(int)
        assert len(mine) % BLOCK == 0 and len(mine) - len(real) < BLOCK and (np.diff(real) > 0).all()
        assert (mine[: len(real)] != 0xFFFF).all()
        view, tile = divmod(index, plan.tiles)
        across = -(-size[0] // width)
        rows, columns = tile // across * height + (real >> 2 & (height - 1)), tile % across * width + (real >> bits + 2)
        assert (seen[rows, columns, real & 3] == -1).all()
        seen[rows, columns, real & 3] = plan.shown[view]
    assert np.array_equal(seen, table)


def test_tiles_grow_with_the_number_of_views():
    shown = Panel.load("65in-8k-96v")
    for views in (2, 8, 24, 96, 150):
        small = Panel(**{**shown.to_dict(), "views": views, "width_px": 2048, "height_px": 512})
        for device in ("cpu", "cuda"):
            plan = SortedPlan(small, device=device)
            full = plan.starts.diff().view(plan.count, plan.tiles)
            assert 160 <= full.float().mean() <= 288


def test_part_of_a_plan_is_that_part():
    shown = panel(views=20)
    plan = SortedPlan(shown, random_map(shown, 20, 2))
    starts, codes = plan.lists(0, plan.count, torch.device("cpu"), True, 1)
    for first, last in ((0, 3), (7, 8), (5, 20)):
        some, of_them = plan.lists(first, last, torch.device("cpu"), False, 3)
        begin, end = first * plan.tiles, last * plan.tiles
        assert torch.equal(some, starts[begin : end + 1] - starts[begin])
        assert torch.equal(of_them, codes[starts[begin] : starts[end]])
        assert plan.bytes(first, last) == 8 * some.numel() + 2 * of_them.numel()


def test_a_plan_serves_many_images_and_survives_a_changed_map():
    shown, scene = panel(views=9), random_scene(30, seed=1)
    table, cameras = random_map(shown, 9, 4), toe_in(shown, 9)
    plan = SortedPlan(shown, table, 9)
    want = sorted_image(scene, shown, cameras, table)
    assert torch.equal(sorted_image(scene, shown, cameras, plan), want)
    assert torch.equal(sorted_image(scene, shown, cameras, plan), want)
    changed = SortedPlan(shown, table, 9)
    table[:] = 10_000
    table[::2] = 3
    assert sorted_image(scene, shown, cameras, changed).shape == want.shape


# Memory


def wide_case(degree=0):
    shown = panel(width_px=320, height_px=120)
    return shown, random_scene(3000, degree, seed=2, size=0.02).to(torch.float32), toe_in(shown, 96)


@pytest.mark.parametrize("degree", [0, 2])
def test_any_budget_gives_the_same_bits_and_is_kept(degree):
    shown, scene, cameras = wide_case(degree)
    whole, stats = sorted_image(scene, shown, cameras, output="float32", stats=(free := {})), {}
    assert sum(free["memory_bytes_unchunked"].values()) >= sum(free["memory_bytes"].values())
    total = sum(free["memory_bytes_unchunked"].values())
    for share in (2, 5, 12):
        image = sorted_image(scene, shown, cameras, output="float32", memory_budget=total // share, stats=stats)
        assert torch.equal(image, whole)
        assert stats["work_bytes"] == sum(stats["memory_bytes"].values()) <= total // share
        assert set(stats["memory_bytes"]) == {"geometry", "image", "binning"}
        assert stats["memory_bytes_unchunked"] == free["memory_bytes_unchunked"]
        assert stats["pairs"] == free["pairs"] and stats["evaluations"] == free["evaluations"]
    assert stats["memory_bytes"]["geometry"] < free["memory_bytes"]["geometry"] / 4


def test_reported_memory_is_that_of_the_arrays():
    shown, scene, cameras = wide_case()
    sorted_image(scene, shown, cameras, output="float32", stats=(stats := {}))
    unchunked = stats["memory_bytes_unchunked"]
    splats = 96 * 3000 * (12 + 4) * 4  # what project writes of every Gaussian in every view
    assert splats <= unchunked["geometry"] <= 1.2 * splats
    codes = 2 * 3 * shown.width_px * shown.height_px
    assert codes <= unchunked["image"] <= 1.5 * codes + 1e5
    assert unchunked["binning"] >= 4 * 96 * 3000


def test_numbers_may_be_those_of_numpy():
    shown, scene = panel(views=9), random_scene(40).to(torch.float32)
    cameras = toe_in(shown, 9)
    same = Cameras(
        cameras.world_to_camera,
        cameras.focal_px,
        cameras.principal_point_px,
        np.int64(cameras.width_px),
        np.int32(cameras.height_px),
    )
    assert type(same.width_px) is type(same.height_px) is int
    images = [
        encode(scene, shown, None, "sorted", cameras=given, **options)
        for given, options in ((cameras, {}), (same, dict(threads=np.int64(1), memory_budget=np.int64(10**8))))
    ]
    assert torch.equal(*images)


def test_the_least_budget_is_named_and_enough():
    shown, scene, cameras = wide_case()
    whole = sorted_image(scene, shown, cameras, output="uint8")
    with pytest.raises(InputError, match="memory budget of 1000 bytes is too small") as error:
        sorted_image(scene, shown, cameras, output="uint8", memory_budget=1000)
    least = int(re.search(r"need (\d+) bytes", str(error.value))[1])
    image = sorted_image(scene, shown, cameras, output="uint8", memory_budget=least, stats=(stats := {}))
    assert torch.equal(image, whole) and sum(stats["memory_bytes"].values()) <= least
    with pytest.raises(InputError, match="memory budget of .* is too small"):
        sorted_image(scene, shown, cameras, output="uint8", memory_budget=int(0.9 * least))


RESIDENT = """
import sys; sys.path.insert(0, sys.argv[1])
import torch
from rasterizer_cases import panel, random_scene
from sorted_cases import toe_in
from lightfield_gs import encode
def status(key):
    return next(1024 * int(line.split()[1]) for line in open("/proc/self/status") if line.startswith(key))
shown = panel(width_px=1200, height_px=700)
scene, cameras = random_scene(60_000, size=0.01).to(torch.float32), toe_in(shown, 96)
encode(random_scene(9).to(torch.float32), panel(), None, "sorted", cameras=toe_in(panel(), 96))
open("/proc/self/clear_refs", "w").write("5")
before = status("VmRSS")
image = encode(scene, shown, None, "sorted", cameras=cameras, memory_budget=int(sys.argv[2]))
print(status("VmHWM") - before - image.numel())
"""


@pytest.mark.not_sanitized
@pytest.mark.parametrize("budget", [120_000_000, 40_000_000])
def test_the_process_grows_by_no_more_than_the_budget(budget):
    try:
        open("/proc/self/clear_refs", "w").close()
    except OSError:
        pytest.skip("this system does not tell the peak of a process's memory")
    # Buffers then go back to the system when they are freed, and what stays is what is in use
    environment = {**os.environ, "MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}
    done = subprocess.run(
        [sys.executable, "-c", RESIDENT, str(Path(__file__).parents[1]), str(budget)],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
    )
    assert budget / 3 <= int(done.stdout) <= budget


def test_same_bits_on_any_number_of_threads():
    shown, scene, cameras = wide_case(1)
    images = [sorted_image(scene, shown, cameras, output="float32", threads=threads) for threads in (1, 2, 3, 2)]
    assert all(torch.equal(images[0], image) for image in images[1:])


# Bad input


def refused(match, scene=None, shown=None, method="sorted", **options):
    shown = shown or panel(views=9)
    with pytest.raises(InputError, match=match) as error:
        encode(scene or random_scene(5), shown, options.pop("rig", None), method, **options)
    assert "\n" not in str(error.value)


def test_cameras_that_do_not_fit_are_named():
    shown = panel(views=9)
    refused("rig, or cameras")
    refused("panel has 9 views", cameras=toe_in(shown, 8))
    refused("110 x 46", cameras=toe_in(panel(width_px=111), 9))
    batch = toe_in(shown, 9)
    batch = batch.__class__(batch.world_to_camera[None], batch.focal_px[None], batch.principal_point_px[None], 110, 46)
    refused(r"\[N, 4, 4\]", cameras=batch)
    refused("continuous", cameras=toe_in(shown, 9), views="continuous")
    refused("continuous", rig=rig(shown), view_map=random_map(shown, 9, 1), views="continuous")


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda t: t[:-1], r"int32 \[46, 110, 3\]"),
        (lambda t: t.astype(np.int64), "int64"),
        (lambda t: t.astype(np.float32), "float32"),
        (lambda t: t[..., :2], r"\[46, 110, 2\]"),
        (lambda t: np.where(t == 3, 9, t), r"0\.\.8"),
        (lambda t: np.where(t == 3, -2, t), "-2"),
        (lambda t: torch.from_numpy(t).double(), "float64"),
    ],
)
def test_maps_that_do_not_fit_are_named(change, words):
    table = random_map(panel(views=9), 9, 1)
    refused(words, cameras=toe_in(panel(views=9), 9), view_map=change(table))
    refused(words, rig=rig(panel(views=9)), view_map=change(table))


def test_options_of_other_methods_are_refused():
    shown = panel(views=9)
    for method in ("direct", "classic"):
        refused("sorted", method=method, rig=rig(shown), cameras=toe_in(shown, 9))
        refused("sorted", method=method, rig=rig(shown), view_map=random_map(shown, 9, 1))
        refused("sorted", method=method, rig=rig(shown), memory_budget=10**9)
        refused("needs a rig", method=method)
    for budget in (0, -5, 1.5, True, "256MB"):
        refused("memory_budget", rig=rig(shown), memory_budget=budget)
    refused("memory_budget", rig=rig(shown), memory_budget=10**9, views="continuous")
    refused("plan is for", rig=rig(shown), view_map=SortedPlan(panel(views=8)))
    refused("made for cuda", rig=rig(shown), view_map=SortedPlan(shown, device="cuda"))
