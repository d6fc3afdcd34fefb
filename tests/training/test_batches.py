"""The batch of a training step: sampling, crops, cameras, augmentation."""

from pathlib import Path

import numpy as np
import pytest
import torch
from srn_scene import FOCAL, look_at

from lightfield_gs import InputError
from lightfield_gs.models.crop import Square, crop_resize
from training.data.batches import Batch, make_batch
from training.data.cache import load_set
from training.data.images import read_view
from training.data.objects import find_objects, read_object
from training.data.plan import Augmentation, BatchPlanner, mirrored, relative_cameras
from training.data.resident import ResidentViews
from training.data.sampler import ViewSampler
from training.data.transfer import packed

pytestmark = [pytest.mark.long_file, pytest.mark.not_sanitized]

AZIMUTHS = (0, -25, -10, 10, 25, 100)


def fan() -> np.ndarray:
    return np.stack([look_at(azimuth, 0) for azimuth in AZIMUTHS])


def test_sampler_stays_in_the_cone_and_uses_all_of_it():
    sampler = ViewSampler([fan()], azimuth_deg=30, elevation_deg=12, targets=2, seed=3)
    seen = set()
    for step in range(200):
        (choice,) = sampler.draw(step, step, 1)
        seen |= {(choice.source, target) for target in choice.targets}
        assert choice.source not in choice.targets
    wanted = {(a, b) for a in range(5) for b in range(5) if a != b and abs(AZIMUTHS[a] - AZIMUTHS[b]) <= 30}
    assert seen == wanted  # view 5, at 100 degrees, has no neighbour


def test_full_sphere_takes_every_view():
    sampler = ViewSampler([fan()], azimuth_deg=180, elevation_deg=90, targets=3, seed=0)
    seen = {choice.source for step in range(100) for choice in sampler.draw(step, step, 1)}
    assert seen == set(range(6))


def test_sampler_depends_on_seed_and_step_alone():
    first, second = (ViewSampler([fan()] * 7, 30, 12, 3, seed=5) for _ in range(2))
    first.draw(0, 0, 4)
    assert first.draw(9, 36, 4) == second.draw(9, 36, 4)
    assert first.draw(9, 36, 4) != ViewSampler([fan()] * 7, 30, 12, 3, seed=6).draw(9, 36, 4)


def test_each_epoch_visits_every_object_once():
    sampler = ViewSampler([fan()] * 10, 30, 12, 1, seed=1)
    visited = [choice.object_index for step in range(6) for choice in sampler.draw(step, 5 * step, 5)]
    epochs = [visited[start : start + 10] for start in (0, 10, 20)]
    assert all(sorted(epoch) == list(range(10)) for epoch in epochs)
    assert epochs[0] != epochs[1]


def test_sampler_refuses_an_object_without_neighbours():
    with pytest.raises(InputError, match="object number 1: none of its 2 views"):
        ViewSampler([fan(), np.stack([look_at(0, 0), look_at(90, 0)])], 30, 12, 1, seed=0)


def _project(camera: np.ndarray, point: np.ndarray) -> np.ndarray:
    x, y, z = (camera @ [*point, 1])[:3]
    return np.array([x / z, y / z])


def test_mirrored_cameras_see_mirrored_images():
    camera = relative_cameras(look_at(25, -4), look_at(5, 3))
    point = np.array([0.1, -0.2, 1.2])
    expected = _project(camera, point) * (-1, 1)
    np.testing.assert_allclose(_project(mirrored(camera), point * (-1, 1, 1)), expected, atol=1e-12)
    assert np.linalg.det(mirrored(camera)[:3, :3]) == pytest.approx(1)


def _planner(folder: Path, **augmentation) -> BatchPlanner:
    cached = load_set(folder / "set", folder / "cache", workers=1)
    sampler = ViewSampler([views.camera_to_world for views in cached.objects], 30, 12, 2, seed=0)
    return BatchPlanner(ResidentViews([cached]), sampler, Augmentation(**augmentation))


def _batch(planner: BatchPlanner, *arguments, **options) -> Batch:
    return make_batch(planner.plan(*arguments, **options), planner.views)


@pytest.mark.parametrize("mirror", [0.0, 1.0])
def test_batches_keep_pictures_and_cameras_together(small_set, mirror):
    """The ball at the world's origin must be opaque where each cropped camera projects it."""
    batch = _batch(_planner(small_set, mirror=mirror, colour=0.0, target_zoom=(0.9, 1.3)), 4, 12, 3, 32)
    assert batch.source.shape == (3, 4, 32, 32) and batch.targets.shape == (3, 3, 4, 32, 32)
    torch.testing.assert_close(batch.world_to_camera[:, 0], torch.eye(4).expand(3, 4, 4), atol=1e-6, rtol=0)
    origin = torch.tensor([0, 0, 1.3, 1.0])
    for example in range(3):
        for view in range(3):
            x, y, z = (batch.world_to_camera[example, view] @ origin)[:3]
            assert z == pytest.approx(1.3, abs=1e-4)
            fx, fy, cx, cy = batch.intrinsics[example, view]
            column, row = int(fx * x / z + cx), int(fy * y / z + cy)
            assert batch.targets[example, view, 3, row, column] > 0.999


def test_source_camera_of_a_batch_matches_its_crop(small_set):
    batch = _batch(_planner(small_set, mirror=0.0, colour=0.0, source_jitter=0.0, target_zoom=(1.0, 1.0)), 0, 0, 3, 32)
    torch.testing.assert_close(batch.source, batch.targets[:, 0])
    torch.testing.assert_close(batch.source_intrinsics, batch.intrinsics[:, 0])
    assert (batch.source_intrinsics[:, 0] > FOCAL * 32 / 64).all()  # cropped closer than the frame


def test_colour_augmentation_treats_all_views_alike(small_set):
    plain = _batch(_planner(small_set, mirror=0.0, colour=0.0), 1, 3, 1, 16)
    varied = _batch(_planner(small_set, mirror=0.0, colour=1.0), 1, 3, 1, 16)
    assert torch.equal(plain.source[:, 3], varied.source[:, 3])
    assert not torch.equal(plain.source[:, :3], varied.source[:, :3])
    assert (varied.targets[:, :, :3] <= varied.targets[:, :, 3:] + 1e-6).all()


def test_batch_is_a_function_of_the_step(small_set):
    first, second = _planner(small_set), _planner(small_set)
    _batch(first, 0, 0, 3, 16)
    for a, b in zip(vars(_batch(first, 7, 21, 3, 16)).values(), vars(_batch(second, 7, 21, 3, 16)).values()):
        assert torch.equal(a, b)


def test_parts_make_up_the_whole_batch(small_set):
    planner = _planner(small_set)
    whole = _batch(planner, 5, 20, 4, 16)
    parts = [_batch(planner, 5, 20, 4, 16, part=part) for part in (slice(0, 2), slice(2, 4))]
    for all_of_it, *pieces in zip(*(vars(batch).values() for batch in (whole, *parts))):
        torch.testing.assert_close(torch.cat(pieces), all_of_it, atol=1e-6, rtol=0)


def _frame(folder: Path, planner: BatchPlanner, row: int) -> torch.Tensor:
    """A view as it is on disk, premultiplied [4,H,W], 0..255; the objects of small_set have four views each."""
    views = read_object(find_objects(folder / "set")[row // 4])
    return torch.from_numpy(read_view(views, row % 4)).permute(2, 0, 1)


@pytest.mark.parametrize(
    "source_px, target_px, zoom",
    [(8, 8, (0.6, 1.3)), (32, 32, (0.6, 1.3)), (16, 16, (1.5, 3.0)), (70, 70, (0.3, 0.5)), (32, 12, (0.6, 1.3))],
)
def test_crops_are_those_of_photos(small_set, source_px, target_px, zoom):
    """The batch of a plan equals crop_resize on whole frames, one by one, flipped as planned.

    Every view has a camera of its own.
    """
    planner = _planner(small_set, colour=0.0, source_jitter=0.2, target_zoom=zoom)
    planner.views.intrinsics += np.arange(12)[:, None] * (1, 2, 0.5, 0.25)
    plan = planner.plan(2, 6, 3, source_px, target_px)
    batch, reached = make_batch(plan, planner.views), set()
    rows = [[planner.views.rectangles.tolist().index(row) for row in rows] for rows in plan.rectangles.tolist()]
    for example, image in np.ndindex(3, 4):
        frame = _frame(small_set, planner, rows[example][image])
        fx, fy, cx, cy = planner.views.intrinsics[rows[example][image]]
        if plan.directions[example] < 0:
            frame, cx = frame.flip(-1), frame.shape[2] - cx
        size_px = target_px if image else source_px
        square = Square(*(int(value) for value in plan.crops[example, image]))
        expected = (crop_resize(frame, square, size_px) / 255).clamp(0, 1)
        found = batch.targets[example, image - 1] if image else batch.source[example]
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=0)
        camera = square.intrinsics((fx, fy), (cx, cy), size_px)
        torch.testing.assert_close(plan.intrinsics[example, image], torch.tensor(camera), check_dtype=False)
        reached.add(square.left < 0 or square.top < 0)
    assert zoom[1] < 1.5 or True in reached


def test_compiled_batches_are_the_same_and_compiled_once(small_set):
    """Windows and filters have the sizes of a stage, not of a step; and plans may come in one piece."""
    planner = _planner(small_set, blur_px=0.5, noise=0.02, outline_px=1.0)
    torch.compiler.reset()
    with torch._dynamo.config.patch(error_on_recompile=True):
        for step in range(3):
            plan = planner.plan(step, 3 * step, 3, 16, 8)
            expected = make_batch(plan, planner.views)
            found = make_batch(packed(plan, torch.device("cpu")), planner.views, compiled=True)
            for a, b in zip(vars(found).values(), vars(expected).values()):
                torch.testing.assert_close(a, b, atol=1e-5, rtol=0)


def test_a_plan_is_copied_in_one_piece(small_set):
    plan = _planner(small_set, noise=0.02).plan(1, 3, 3, 16)
    copy = packed(plan, torch.device("cpu"))
    for record, copied in ((plan, copy), (plan.photo, copy.photo)):
        for expected, found in zip(vars(record).values(), vars(copied).values()):
            if isinstance(expected, torch.Tensor):
                assert torch.equal(found, expected) and found.dtype == expected.dtype and found.is_contiguous()
                assert found.untyped_storage().data_ptr() == copy.origins.untyped_storage().data_ptr()
                assert found.data_ptr() % 16 == 0
    assert (copy.window_px, copy.taps, copy.procedural) == (plan.window_px, plan.taps, None)


def test_targets_are_drawn_without_replacement_where_there_are_enough():
    sampler = ViewSampler([fan()], azimuth_deg=180, elevation_deg=90, targets=5, seed=0)
    for step in range(50):
        (choice,) = sampler.draw(step, step, 1)
        assert sorted((choice.source, *choice.targets)) == list(range(6))
    few = ViewSampler([fan()], azimuth_deg=30, elevation_deg=12, targets=5, seed=0)
    assert all(len(choice.targets) == 5 for choice in few.draw(0, 0, 20))


def test_a_part_of_a_step_is_drawn_alike():
    sampler = ViewSampler([fan()] * 7, 30, 12, 3, seed=5)
    whole = sampler.draw(9, 36, 12)
    assert sampler.draw(9, 36, 12, np.array([2, 5, 11])) == [whole[i] for i in (2, 5, 11)]
