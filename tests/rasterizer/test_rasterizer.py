"""Ordinary images: colours, alpha and depth against the oracle."""

import numpy as np
import pytest
import torch
from rasterizer_cases import dense_views, hard_scene, random_scene, stacked, turned_pose

from lightfield_gs import reference, render
from lightfield_gs.base.errors import InputError
from lightfield_gs.bench.scenes import cloud, sheet
from lightfield_gs.scene.cameras import Cameras
from lightfield_gs.scene.gaussians import Gaussians

SETTLED = 2e-3


def cameras_of(views, width, height, dtype=torch.float64) -> Cameras:
    pose, camera, limits = (view.to(dtype) for view in views)
    return Cameras(pose, camera[..., :2], camera[..., 2:], width, height, jacobian_limits=limits)


def op(scenes: Gaussians, background, views, width, height):
    return torch.ops.lightfield_gs.render_images(*scenes.fields().values(), background, *views, width, height)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("size", [(1, 1), (17, 5), (5, 37), (33, 50), (64, 32)])
def test_image_alpha_and_depth(degree, size):
    width, height = size
    scenes = stacked([random_scene(40, degree, seed) for seed in (1, 2)])
    views = dense_views(2, 3, width, height)
    background = torch.rand(2, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    got = op(scenes, background, views, width, height)
    want = reference.dense_torch(*scenes.fields().values(), background, *views, width, height)
    for have, true, shape in zip(got, want, ((2, 3, height, width, 3), (2, 3, height, width), (2, 3, height, width))):
        assert have.shape == shape and have.dtype == torch.float64
        torch.testing.assert_close(have, true, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["sheet", "cloud"])
def test_float32_images_of_many_gaussians(kind):
    width, height = 300, 150
    gaussians = sheet(96) if kind == "sheet" else cloud(20_000)
    views = dense_views(1, 2, width, height)
    cameras = cameras_of([view[0] for view in views], width, height)
    image = render(gaussians, cameras, background=(0.3, 0.6, 0.9)).image
    assert image.dtype == torch.float32 and image.shape == (2, height, width, 3)
    random = np.random.default_rng(3)
    rows, columns, channels = (random.integers(0, size, 4000) for size in (height, width, 3))
    for view in range(2):
        want, margin = reference.pixel_colours(
            gaussians, cameras, view, rows, columns, channels, background=(0.3, 0.6, 0.9), return_margin=True
        )
        error = np.abs(image[view].numpy()[rows, columns, channels] - want)
        assert error[margin > SETTLED].max() < 4e-4 and np.sqrt(np.mean(error**2)) < 1e-4


@pytest.mark.parametrize("dtype, atol, margin", [(torch.float64, 1e-9, 1e-9), (torch.float32, 5e-4, SETTLED)])
@pytest.mark.parametrize("kind", ["clamped", "needles", "huge", "opaque", "specks", "near and far", "equal depths"])
def test_gaussians_that_are_hard(kind, dtype, atol, margin):
    scene = hard_scene(kind, 60, seed=5)
    width, height = 70, 50
    camera = Cameras(
        torch.eye(4, dtype=torch.float64)[None],
        torch.tensor([[60.0, 70.0]], dtype=torch.float64),
        torch.tensor([[30.0, 27.0]], dtype=torch.float64),
        width,
        height,
    )
    image = render(scene.to(dtype), camera, background=(0.2, 0.4, 0.6)).image[0].double().numpy()
    rows, columns, channels = (index.ravel() for index in np.indices((height, width, 3)))
    # Rounded first, so that equal depths stay equal and near planes stay where they are.
    want, near = reference.pixel_colours(
        scene.to(dtype), camera, 0, rows, columns, channels, background=(0.2, 0.4, 0.6), return_margin=True
    )
    assert np.abs(image.ravel() - want)[near > margin].max() < atol


def test_alpha_and_expected_depth_of_render():
    scene, (width, height) = random_scene(40, 0, 3), (40, 30)
    views = [view[0] for view in dense_views(1, 2, width, height)]
    image, alpha, depth, _ = render(scene, cameras_of(views, width, height), alpha=True, depth=True)
    sums = op(stacked([scene]), torch.ones(1, 2, 3, dtype=torch.float64), [view[None] for view in views], width, height)
    torch.testing.assert_close(image, sums[0][0])
    torch.testing.assert_close(alpha, sums[1][0])
    lit = alpha > 0
    torch.testing.assert_close(depth[lit], (sums[2][0] / sums[1][0])[lit])
    assert torch.isfinite(depth).all() and 1.0 < depth[lit].min() and depth.max() < 3.0
    only = render(scene, cameras_of(views, width, height), depth=True)
    assert only.alpha is None and only.radii is None and torch.equal(only.depth, depth)


def test_batches_are_scene_by_scene():
    scenes = [random_scene(30, 1, seed) for seed in (1, 2, 3)]
    views = dense_views(3, 2, 40, 24)
    together = render(stacked(scenes), cameras_of(views, 40, 24)).image
    assert together.shape == (3, 2, 24, 40, 3)
    for b, scene in enumerate(scenes):
        assert torch.equal(together[b], render(scene, cameras_of([view[b] for view in views], 40, 24)).image)


def test_one_set_of_cameras_serves_a_whole_batch():
    scenes = stacked([random_scene(30, 1, seed) for seed in (1, 2)])
    views = [view[0] for view in dense_views(1, 3, 40, 24)]
    shared = render(scenes, cameras_of(views, 40, 24)).image
    repeated = render(scenes, cameras_of([view.expand(2, *view.shape) for view in views], 40, 24)).image
    assert torch.equal(shared, repeated)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("kind", ["none", "behind", "outside", "faint"])
def test_nothing_to_draw_leaves_the_background(kind, dtype):
    scene = random_scene(0 if kind == "none" else 30, 1, dtype=dtype)
    if kind == "behind":
        scene.means[:, 2] -= 9
    elif kind == "outside":
        scene.means[:, 0] += 90
    elif kind == "faint":
        scene.opacities[:] = 0.003
    views = [view[0] for view in dense_views(1, 2, 40, 24)]
    image, alpha, depth, _ = render(scene, cameras_of(views, 40, 24), background=(0.25, 0.5, 1), alpha=True, depth=True)
    assert torch.equal(image, torch.tensor([0.25, 0.5, 1], dtype=dtype).expand_as(image))
    assert not alpha.any() and not depth.any()


def test_default_limits_are_those_of_the_frustum():
    scene = random_scene(30, 0, 8, extent=4.0, size=0.5)
    pose, camera, limits = (view[0] for view in dense_views(1, 2, 40, 24))
    plain = render(scene, Cameras(pose, camera[:, :2], camera[:, 2:], 40, 24)).image
    torch.testing.assert_close(
        plain, render(scene, cameras_of([pose, camera, limits], 40, 24)).image, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_same_bits_in_every_run_and_on_any_number_of_threads(dtype):
    scenes = stacked([random_scene(300, 2, seed, dtype=dtype) for seed in (1, 2)])
    views = [view.to(dtype) for view in dense_views(2, 3, 70, 50)]
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 2):
            torch.set_num_threads(threads)
            results.append(op(scenes, torch.ones(2, 3, 3, dtype=dtype), views, 70, 50))
    finally:
        torch.set_num_threads(before)
    for again in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], again))


def test_moving_camera_and_scene_together_changes_nothing():
    # Degree 0: harmonics belong to world axes.
    scene = random_scene(60, 0, 9)
    pose = torch.from_numpy(turned_pose(0.3, -0.2))
    camera = dict(
        focal_px=torch.tensor([[60.0, 65.0]], dtype=torch.float64),
        width_px=50,
        height_px=40,
        principal_point_px=torch.tensor([[24.0, 21.0]], dtype=torch.float64),
    )
    seen = render(scene, Cameras(pose[None], **camera)).image
    moved = Gaussians(scene.means @ pose[:3, :3].T + pose[:3, 3], *list(scene.fields().values())[1:])
    half = [
        torch.tensor([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])
        for angle, axis in ((-0.2, (1, 0, 0)), (0.3, (0, 1, 0)))
    ]
    turn = product(half[0], half[1])
    moved.quaternions = product(turn.expand(60, 4), scene.quaternions)
    torch.testing.assert_close(
        render(moved, Cameras(torch.eye(4, dtype=torch.float64)[None], **camera)).image, seen, rtol=0, atol=1e-12
    )


def product(a, b):
    w, x, y, z = a.unbind(-1)
    i, j, k, m = b.unbind(-1)
    return torch.stack(
        [
            w * i - x * j - y * k - z * m,
            w * j + x * i + y * m - z * k,
            w * k - x * m + y * i + z * j,
            w * m + x * k - y * j + z * i,
        ],
        -1,
    )


def arguments(dtype=torch.float32):
    scenes = stacked([random_scene(5, 1, dtype=dtype)])
    views = [view.to(dtype) for view in dense_views(1, 2, 8, 6)]
    return [*scenes.fields().values(), torch.ones(1, 2, 3, dtype=dtype), *views]


NAMES = ("means", "quaternions", "scales", "opacities", "sh", "background", "world_to_camera", "intrinsics", "limits")


@pytest.mark.parametrize("index", range(9))
def test_wrong_shapes_are_named(index):
    tensors = arguments()
    tensors[index] = tensors[index][..., :-1]
    with pytest.raises(InputError, match="must be") as error:
        torch.ops.lightfield_gs.render_images(*tensors, 8, 6)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("index", range(9))
def test_wrong_dtypes_are_named(index):
    for dtype in (torch.float64, torch.float16, torch.int64):
        tensors = arguments()
        tensors[index] = tensors[index].to(dtype)
        with pytest.raises(InputError):
            torch.ops.lightfield_gs.render_images(*tensors, 8, 6)


@pytest.mark.parametrize("width, height", [(0, 6), (8, 0), (-8, 6), (1 << 40, 6)])
def test_impossible_sizes_are_refused(width, height):
    with pytest.raises(InputError):
        torch.ops.lightfield_gs.render_images(*arguments(), width, height)


def test_tensors_need_not_be_contiguous():
    tensors = arguments(torch.float64)
    want = torch.ops.lightfield_gs.render_images(*tensors, 8, 6)
    strided = [torch.stack([tensor, tensor], -1)[..., 0] for tensor in tensors]
    got = torch.ops.lightfield_gs.render_images(*strided, 8, 6)
    assert all(torch.equal(a, b) for a, b in zip(got, want))


def test_render_names_bad_cameras():
    scene = random_scene(5)
    pose, camera, _ = (view[0] for view in dense_views(1, 2, 8, 6))
    for pose_, focal, width in (
        (pose[:, :3], camera[:, :2], 8),
        (pose, -camera[:, :2], 8),
        (pose, camera[:, :1], 8),
        (pose * float("nan"), camera[:, :2], 8),
        (pose, camera[:, :2], 0),
    ):
        with pytest.raises(InputError):
            render(scene, Cameras(pose_, focal, camera[:, 2:], width, 6))
