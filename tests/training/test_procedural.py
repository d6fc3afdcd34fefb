"""Procedural objects: pictures that are true to their geometry, and the same whatever process draws them."""

import dataclasses

import numpy as np
import pytest
import torch

from training.data import plan as plan_module
from training.data import procedural
from training.data.batches import make_batch
from training.data.cache import load_set
from training.data.plan import Augmentation, BatchPlanner, made_up
from training.data.procedural import draw_pictures, steps_of_block
from training.data.procedural_plan import CELLS, DISTANCE, NUMBERS, ProceduralPlan, draw_objects, orbit
from training.data.resident import ResidentViews
from training.data.sampler import ViewSampler
from training.data.superquadrics import SHAPE, lengths, lies_inside, named, profile_points, section_points
from training.data.textures import PIECE_PX, Photographs

pytestmark = pytest.mark.long_file

CONE_DEG = (30.0, 12.0)


def _plan(
    count: int, sizes: tuple[int, int] = (32, 32), views: int = 3, seed: int = 0, photographs: Photographs | None = None
) -> ProceduralPlan:
    rows = np.random.default_rng(seed).random((count, NUMBERS))
    framing = np.ones((count, 1 + views)), np.zeros((count, 1 + views, 2))
    return draw_objects(rows, CONE_DEG, sizes, framing, np.ones((count, views, 3)), photographs)


def _random_parts(count: int) -> dict[str, torch.Tensor]:
    """Numbers of SHAPE, but for the placement, of parts of all kinds."""
    u = torch.from_numpy(np.random.default_rng(1).random((8, count)))
    v = torch.from_numpy(np.random.default_rng(4).random((6, count)))
    irregular = torch.arange(count) % 2 == 1
    return {
        "half": (0.05 + 0.3 * u[:3]).T,
        "hole": torch.where(u[3] < 0.4, 0.5 + u[3], 0.0),
        "profile": 1.2 + 9 * u[4],
        "section": 1.2 + 7 * u[5],
        "taper": 0.8 * (2 * u[6] - 1),
        "wave": 0.1 * u[7],
        "waves": 1 + 6 * u[0],
        "bend": 0.3 * u[1],
        "lobe": torch.where(irregular, 0.4 * v[0], 0.0),
        "lobes": (2 + 6 * v[1]).floor(),
        "turn": 6 * v[2],
        "curve": torch.where(irregular, 0.5 * v[3], 0.0),
        "curves": 2 + 7 * v[4],
        "begin": 6 * v[5],
        "relief": torch.zeros(count),
    }


def _field(part: dict[str, torch.Tensor], points: torch.Tensor) -> torch.Tensor:
    """Barr's inside-outside function with his taper and bend, lobes and turned profile undone: 1 on the surface."""
    x, y, z = (points / part["half"]).unbind(-1)
    x = x - part["bend"] * (z**2 - 0.5) / part["half"][..., 0]
    growth = 1 + part["taper"] * z + part["wave"] * torch.cos(part["waves"] * z)
    growth = growth * (1 - part["curve"] / 2 + part["curve"] / 2 * torch.sin(part["curves"] * z + part["begin"]))
    angle = torch.complex(x, y).angle()
    growth = growth * (1 - part["lobe"] / 2 + part["lobe"] / 2 * torch.cos(part["lobes"] * angle + part["turn"]))
    section = ((x / growth).abs() ** part["section"] + (y / growth).abs() ** part["section"]) ** (1 / part["section"])
    ring = ((section - part["hole"]) / (1 - part["hole"])).abs()
    return ring ** part["profile"] + z.abs() ** part["profile"]


def _on_surface(part: dict[str, torch.Tensor], count: int) -> torch.Tensor:
    """Points [count, parts, 3] of the surfaces."""
    s, t = torch.from_numpy(np.random.default_rng(2).random((2, count, 1)))
    (radius, shift, z), (x, y) = profile_points(part, s).unbind(-1), section_points(part, t).unbind(-1)
    return torch.stack([radius * x + shift, radius * y, z], -1)


def test_surfaces_obey_the_equation_of_superquadrics():
    parts = _random_parts(200)
    found = _field(parts, _on_surface(parts, 300))
    torch.testing.assert_close(found, torch.ones_like(found), atol=2e-3, rtol=0)


def test_inside_is_what_the_equation_says():
    parts = _random_parts(50)
    points = torch.from_numpy(np.random.default_rng(3).uniform(-0.4, 0.4, (500, 50, 3)))
    deep = _field(parts, points) < 0.97 ** parts["profile"]
    assert 0.02 < deep.double().mean() < 0.9
    assert (lies_inside(parts, points) == deep).double().mean() > 0.999
    assert not lies_inside(parts, _on_surface(parts, 300)).any()


def test_curves_have_the_length_that_cells_are_counted_by():
    """Of cells laid along a curve none may be much longer than the others: it would stick out at the border."""
    parts = _random_parts(200)
    for points, length in zip((profile_points, section_points), lengths(parts)):
        steps = points(parts, torch.linspace(0, 1, 401)[:, None]).diff(dim=0)
        if points is profile_points:
            width = parts["half"][:, :2].mean(-1)
            steps = torch.stack([steps[..., 0] * width, steps[..., 2]], -1)
            length = length * (1 + parts["taper"].abs())  # which is bounded in proportion where objects are drawn
        assert (400 * steps.norm(dim=-1) / length).max() < 3


def _ball(centre: tuple[float, float, float], radius: float, plan: ProceduralPlan) -> ProceduralPlan:
    """The plan with its first object replaced by a ball, all others left out."""
    side, number = 60, torch.arange(60)
    part = {name: torch.zeros(()) for name in SHAPE} | {
        "half": torch.full((3,), radius),
        "profile": torch.tensor(2.0),
        "section": torch.tensor(2.0),
    }

    def curve(points):
        before, middle, after = (points(part, (number + place) / side) for place in (0, 0.5, 1))
        return torch.cat([middle, after - before], -1)

    numbers = {name: [0.0] * count for name, count in {**SHAPE, **CELLS}.items()} | {
        "matrix": torch.eye(3).flatten().tolist(),
        "centre": centre,
        "half": [radius] * 3,
        "profile": [2.0],
        "section": [2.0],
        "sense": [1.0],
        "columns": [float(side)],
    }
    rows = [torch.tensor([sum((list(numbers[name]) for name in layout), [])])[None] for layout in (SHAPE, CELLS)]
    one = {
        field.name: value[:1]
        for field in dataclasses.fields(plan)
        if isinstance(value := getattr(plan, field.name), torch.Tensor)
    }
    one |= {
        "ends": torch.tensor([[side * side]]),
        "shapes": rows[0],
        "cells": rows[1],
        "looks": plan.looks[:1, :1],
        "profiles": curve(profile_points),
        "sections": curve(section_points),
    }
    return dataclasses.replace(plan, surfels=side * side, **one)


def test_a_ball_is_where_each_camera_sees_it():
    """Against lines of sight: opaque where they pass well inside the ball, clear where they miss it."""
    centre, radius = (0.11, -0.07, 1.38), 0.21
    plan = _ball(centre, radius, _plan(1, (40, 56), views=5))
    source, source_intrinsics, targets, intrinsics = draw_pictures(plan)
    assert source.shape == (1, 4, 40, 40) and targets.shape == (1, 5, 4, 56, 56)
    seen = [(source[0], source_intrinsics[0], plan.world_to_camera[0, 0])]
    seen += list(zip(targets[0], intrinsics[0], plan.world_to_camera[0]))
    for image, (fx, fy, cx, cy), camera in seen:
        size = image.shape[-1]
        middle = (camera @ torch.tensor([*centre, 1.0]))[:3]
        row, column = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
        rays = torch.stack([(column - cx) / fx, (row - cy) / fy, torch.ones_like(row)], -1)
        distance = torch.linalg.cross(rays, middle.expand_as(rays)).norm(dim=-1) / rays.norm(dim=-1)
        pixel = middle[2] / fx
        assert (image[3][distance < radius - 1.5 * pixel] > 0.95).all()
        assert (image[3][distance > radius + 2.5 * pixel] < 0.02).all()
        assert 0.5 < (distance < radius).float().mean() * 4 / np.pi < 1  # it fills its square but for the margin


def test_pictures_are_premultiplied_and_whole():
    source, _, targets, _ = draw_pictures(_plan(6))
    for images in (source, targets):
        assert images.min() >= 0 and images.max() <= 1
        assert (images[..., :3, :, :] <= images[..., 3:, :, :] + 1e-5).all()
        filled = images[..., 3, :, :].mean((-1, -2))
        assert (filled > 0.02).all() and (filled < 0.95).all()
        assert (images[..., 3, [0, 0, -1, -1], [0, -1, 0, -1]] < 0.02).all()
    assert not source.requires_grad


def test_the_first_target_is_the_source_view():
    plan = _plan(4)
    source, source_intrinsics, targets, intrinsics = draw_pictures(plan)
    torch.testing.assert_close(plan.world_to_camera[:, 0], torch.eye(4).expand(4, 4, 4), atol=1e-6, rtol=0)
    torch.testing.assert_close(source_intrinsics, intrinsics[:, 0])
    torch.testing.assert_close(source, targets[:, 0], atol=1e-5, rtol=0)


def _photographs() -> Photographs:
    """A coloured piece and a grey one."""
    noise = torch.from_numpy(np.random.default_rng(0).integers(256, size=(2, PIECE_PX, PIECE_PX, 3), dtype=np.uint8))
    noise[1] = noise[1, ..., :1]
    return Photographs(noise)


@pytest.mark.parametrize("photographs", [None, _photographs()], ids=["regular", "clothed"])
def test_unseen_surfels_make_no_difference(monkeypatch, photographs):
    """Surfels that are left out face away from all cameras, or lie in another part."""
    plan = _plan(4, (48, 48), photographs=photographs)
    expected, surfels = draw_pictures(plan)[0], procedural._surfels(plan)
    kept = procedural._visible(surfels, plan)
    assert kept["filled"].sum() < 0.8 * plan.ends[:, -1].sum()
    real = surfels["part"] < plan.ends.shape[1]
    everything = {
        name: torch.where(real[..., None], values, values[:, :1])  # spare ones repeat the first
        for name, values in surfels.items()
        if name != "part"
    }
    everything |= {"part": torch.where(real, surfels["part"], 0), "filled": real.float()}
    monkeypatch.setattr(procedural, "_visible", lambda *_: everything)
    assert (draw_pictures(plan)[0] - expected).abs().mean() < 0.01


def test_photographs_change_skins_and_shapes_and_nothing_else():
    regular, clothed = _plan(4), _plan(4, photographs=_photographs())
    for name in ("sides", "shifts", "world_to_camera", "light"):
        torch.testing.assert_close(getattr(clothed, name), getattr(regular, name))
    irregular = named(clothed.shapes, SHAPE)
    assert not any(named(regular.shapes, SHAPE)[name].any() for name in ("lobe", "curve", "relief"))
    assert all(irregular[name].any() for name in ("lobe", "curve", "relief"))
    source, _, targets, _ = draw_pictures(clothed)
    torch.testing.assert_close(source, targets[:, 0], atol=1e-5, rtol=0)
    assert (source[:, :3] <= source[:, 3:] + 1e-5).all() and 0.02 < source[:, 3].mean() < 0.95
    assert (source - draw_pictures(regular)[0]).abs().mean() > 0.02


def test_cameras_stand_in_the_cone_and_look_at_the_object():
    rng = np.random.default_rng(0)
    azimuth, elevation = np.radians(30) * rng.uniform(-1, 1, (2, 100))
    cameras = orbit(azimuth, elevation, rng.uniform(-0.2, 0.6, 100), rng.uniform(-3, 3, 100))
    middle = np.array([0, 0, DISTANCE, 1])
    np.testing.assert_allclose(cameras @ middle, np.tile(middle, (100, 1)), atol=1e-12)
    np.testing.assert_allclose(cameras[:, :3, :3] @ cameras[:, :3, :3].mT, np.tile(np.eye(3), (100, 1, 1)), atol=1e-12)
    upright = orbit(azimuth, 0 * elevation, 0 * azimuth, 0 * azimuth)  # angle between its axis and the source's
    np.testing.assert_allclose(np.arccos(upright[:, 2, 2]), np.abs(azimuth), atol=1e-12)


def _planner(folder, fraction: float, seed: int = 0) -> BatchPlanner:
    cached = load_set(folder / "set", folder / "cache", workers=1)
    sampler = ViewSampler([views.camera_to_world for views in cached.objects], *CONE_DEG, 2, seed=seed)
    return BatchPlanner(ResidentViews([cached]), sampler, Augmentation(), procedural=fraction)


def test_batches_depend_on_seed_and_step_alone(small_set):
    first, second = _planner(small_set, 0.5), _planner(small_set, 0.5)
    make_batch(first.plan(0, 0, 4, 16), first.views)
    batches = [make_batch(planner.plan(9, 36, 4, 16), planner.views) for planner in (first, second)]
    for a, b in zip(*(vars(batch).values() for batch in batches)):
        assert torch.equal(a, b)
    others = [_planner(small_set, 0.5, seed=1).plan(9, 36, 4, 16), first.plan(10, 40, 4, 16)]
    assert all(not torch.equal(batches[0].source, make_batch(plan, first.views).source) for plan in others)


@pytest.mark.parametrize("fraction", [0.25, 0.5, 1.0])
def test_parts_make_up_the_whole_step(small_set, fraction):
    """Stored views come first in each batch, procedural objects after them, each in the order of the step."""
    planner = _planner(small_set, fraction)
    made = made_up(4, fraction)
    whole = make_batch(planner.plan(5, 20, 4, 16), planner.views)
    for part in (slice(0, 2), slice(2, 4)):
        batch = make_batch(planner.plan(5, 20, 4, 16, part=part), planner.views)
        order = [*np.flatnonzero(~made), *np.flatnonzero(made)]
        rows = [order.index(i) for chosen in (~made[part], made[part]) for i in np.arange(4)[part][chosen]]
        for found, all_of_it in zip(vars(batch).values(), vars(whole).values()):
            torch.testing.assert_close(found, all_of_it[rows], atol=1e-5, rtol=0)


def test_stored_views_stay_the_same_beside_procedural_objects(small_set):
    alone, beside = (
        make_batch(_planner(small_set, fraction).plan(3, 12, 4, 16), _planner(small_set, 0).views)
        for fraction in (0.0, 0.5)
    )
    torch.testing.assert_close(beside.source[:2], alone.source[np.flatnonzero(~made_up(4, 0.5))])


def test_procedural_examples_are_evenly_spread():
    assert made_up(8, 0.25).nonzero()[0].tolist() == [3, 7] and made_up(5, 1.0).all() and not made_up(5, 0.0).any()
    for fraction in (0.1, 0.3, 0.7):
        for size in (1, 2, 4):
            counts = made_up(80, fraction).reshape(size, -1).sum(1)
            assert counts.sum() == round(80 * fraction) and np.ptp(counts) <= 1


def test_objects_of_several_steps_are_drawn_at_once(small_set, monkeypatch):
    """Once in a block, whichever step is the first; the pictures are those of each step alone."""
    count, drawn = 4, []
    planner = _planner(small_set, 0.5)  # two of four
    steps = steps_of_block(2)
    one_by_one = procedural.draw_pictures
    monkeypatch.setattr(procedural, "draw_pictures", lambda plan, _: drawn.append(len(plan.ends)) or one_by_one(plan))
    plans = [planner.plan(step, count * step, count, 16) for step in range(steps - 2, steps + 1)]
    batches = [make_batch(plan, planner.views) for plan in plans]
    assert drawn == [2 * steps, 2 * steps]
    monkeypatch.setattr(plan_module, "steps_of_block", lambda objects: 1)
    alone = [
        make_batch(_planner(small_set, 0.5).plan(step, count * step, count, 16), planner.views)
        for step in range(steps - 2, steps + 1)
    ]
    assert drawn[2:] == [2, 2, 2]
    for found, expected in zip(batches, alone):
        for a, b in zip(vars(found).values(), vars(expected).values()):
            torch.testing.assert_close(a, b, atol=1e-5, rtol=0)


def test_blocks_have_about_as_many_objects():
    assert [steps_of_block(objects) for objects in (1, 4, 5, 32, 100)] == [32, 8, 6, 1, 1]


def test_compiled_objects_are_the_same_and_compiled_once():
    """Blocks have the same shapes, but for the curves and for what is seen. Stored views are compiled in
    test_batches.py."""
    torch.compiler.reset()
    with torch._dynamo.config.patch(error_on_recompile=True):
        for seed in range(3):
            expected, found = (draw_pictures(_plan(8, (16, 16), seed=seed), flag) for flag in (False, True))
            for a, b in zip(found, expected):
                # A surfel at the border of seen and unseen may fall to either side.
                assert (a - b).abs().sum() <= 1e-4 * a.numel()
