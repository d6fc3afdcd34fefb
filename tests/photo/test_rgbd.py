"""A photo and its depth map as Gaussians: against a scene whose views are known, and the geometry of a plane."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rgbd_scene import WALL_NORMAL, camera, view

import lightfield_gs as lf
from lightfield_gs.photo.depth_edges import joined, merge_slivers, slopes, snap_mixed
from lightfield_gs.photo.rgbd import focal_length_px, from_depth

WIDTH, HEIGHT, FOCAL = 160, 120, 140.0


def photo_and_depth() -> tuple[np.ndarray, np.ndarray]:
    colours, depth, _ = view(WIDTH, HEIGHT, FOCAL)
    return colours.astype(np.float32), depth


def rotations(quaternions: torch.Tensor) -> torch.Tensor:
    w, x, y, z = quaternions.double().unbind(1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, 1).view(-1, 3, 3)


# Against what the cameras beside the photo's see


@pytest.mark.parametrize("offset", [0.0, 0.15, -0.4, 0.6])
def test_views_from_the_side_are_those_of_the_scene(offset):
    """The visible scene appears closed and in its colours; the hidden part is filled, not a hole."""
    image, depth = photo_and_depth()
    gaussians = from_depth(image, depth, (FOCAL, FOCAL))
    truth, _, points = view(WIDTH, HEIGHT, FOCAL, offset)
    seen_by = camera(WIDTH, HEIGHT, FOCAL, offset)
    picture, alpha = (out[0].numpy() for out in lf.render(gaussians, seen_by, alpha=True)[:2])
    place = points[..., :2] / points[..., 2:] * FOCAL + [WIDTH / 2, HEIGHT / 2]  # in the photo
    inside = ((place > 2) & (place < [WIDTH - 2, HEIGHT - 2])).all(-1)
    column, row = np.floor(place).astype(int).clip(0, [WIDTH - 1, HEIGHT - 1]).transpose(2, 0, 1)
    shown = inside & (np.abs(depth[row, column] - points[..., 2]) < 0.04)
    error = np.abs(picture - truth).mean(-1)
    assert shown.sum() > 9000 and alpha[shown].min() > 0.95
    assert error[shown].mean() < 0.025 and np.quantile(error[shown], 0.95) < 0.06
    hidden = inside & ~shown
    assert (alpha[hidden] > 0.9).sum() >= 0.95 * hidden.sum()


def test_the_hidden_layer_is_what_fills(monkeypatch):
    """Without it a camera beside looks through the tear."""
    from lightfield_gs.photo import hidden

    image, depth = photo_and_depth()
    whole = from_depth(image, depth, (FOCAL, FOCAL))
    monkeypatch.setattr(hidden, "_C", replace(hidden._C, reach=0.0))
    torn = from_depth(image, depth, (FOCAL, FOCAL))
    assert WIDTH * HEIGHT <= torn.count < whole.count < 1.3 * WIDTH * HEIGHT
    seen_by = camera(WIDTH, HEIGHT, FOCAL, 0.3)
    centre = slice(20, 100), slice(20, 140)
    open_ = [(lf.render(g, seen_by, alpha=True).alpha[0][centre] < 0.5).sum() for g in (whole, torn)]
    assert open_[0] == 0 and open_[1] > 200


# Against geometry


def test_a_gaussian_lies_in_the_surface_and_covers_its_pixel():
    """On the wall: thin along the true normal, and a circle of one pixel's spread in the photo's own camera."""
    image, depth = photo_and_depth()
    focal = (FOCAL, 1.3 * FOCAL)  # the map is read by another camera: the wall is still a plane
    gaussians = from_depth(image, depth, focal, (70.0, 65.0))
    rows, columns = np.mgrid[5:25, 5:60]
    index = torch.from_numpy((rows * WIDTH + columns).ravel())
    points, z = gaussians.means[index].double(), torch.from_numpy(depth[rows, columns].ravel())
    place = points[:, :2] / points[:, 2:] * torch.tensor(focal) + torch.tensor([70.0, 65.0])
    assert torch.allclose(place, torch.from_numpy(np.stack([columns, rows], -1).reshape(-1, 2) + 0.5), atol=1e-3)
    assert torch.allclose(points[:, 2], z, rtol=1e-6)

    axes, scales = rotations(gaussians.quaternions[index]), gaussians.scales[index].double()
    normal = torch.linalg.cross(points[1] - points[0], points[60] - points[0])
    assert (axes[:, :, 2] @ (normal / normal.norm())).abs().min() > 0.9999
    covariance = axes @ torch.diag_embed(scales**2) @ axes.mT
    x, y = (points[:, :2] / points[:, 2:]).T
    zero = torch.zeros_like(x)
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / z, zero, -focal[0] * x / z], 1),
            torch.stack([zero, focal[1] / z, -focal[1] * y / z], 1),
        ],
        1,
    )
    footprint = jacobian @ covariance @ jacobian.mT
    assert torch.allclose(footprint, 0.65**2 * torch.eye(2).double(), atol=0.06)


def test_the_wall_faces_where_it_should():
    image, depth = photo_and_depth()
    gaussians = from_depth(image, depth, (FOCAL, FOCAL))
    thin = rotations(gaussians.quaternions[: WIDTH * 20])[:, :, 2]
    assert (thin @ torch.from_numpy(WALL_NORMAL / np.linalg.norm(WALL_NORMAL))).abs().min() > 0.999


def test_slopes_do_not_cross_edges():
    depth = torch.tensor([[1, 1.01, 1.02, 3, 3.03, torch.nan, 2]])
    assert joined(depth, 10.0).tolist() == [[True, True, False, True, False, False]]
    expected = torch.tensor([[0.1, 0.1 / 1.01, 0.1 / 1.02, 0.1, 0.3 / 3.03, torch.nan, 0]])
    assert torch.allclose(slopes(depth, 10.0), expected, atol=1e-6, equal_nan=True)


def test_smoothed_edges_are_made_sharp_and_thin_things_stay():
    row = torch.tensor([1, 1, 1, 1.2, 2.5, 3, 3, 1, 3, 3, 4, 3, 3.0])
    sharp = snap_mixed(row.repeat(5, 1), (80.0, 80.0))
    assert sharp[2].tolist() == [1, 1, 1, 1, 3, 3, 3, 1, 3, 3, 4, 3, 3]
    assert torch.equal(snap_mixed(row.repeat(5, 1).T.contiguous(), (80.0, 80.0)), sharp.T)


def test_pieces_between_two_surfaces_join_the_one_of_their_colour():
    depth, image = torch.full((40, 40), 4.0), torch.full((40, 40, 3), 0.9)
    depth[10:30, 10:30], image[10:30, 10:30] = 2.0, 0.1
    truth = depth.clone()
    depth[12:17, 30:32], image[12:17, 30:32] = 2.6, 0.15  # of the square
    truth[12:17, 30:32] = 2.0
    depth[20:24, 30:32] = 2.6  # of the wall
    depth[5, 5] = truth[5, 5] = 1.5  # a bead, nearer than all around it
    merged = merge_slivers(depth, image, (80.0, 80.0))
    assert torch.allclose(merged, truth, rtol=0.01)
    assert torch.equal(merge_slivers(truth, image, (80.0, 80.0)), truth)


# Input of all sorts


def test_what_has_no_depth_or_opacity_is_left_out():
    depth = np.full((6, 8), 2.0)
    depth[0, :5] = np.nan, np.inf, 0, -1, 1e30
    image = np.full((6, 8, 4), 0.25, np.float32)
    image[..., 3] = 1
    image[1, :2, 3] = 0, 0.5
    gaussians = from_depth(image, depth).validate()
    assert gaussians.count == 48 - 5 - 1 and gaussians.dtype == torch.float32 and gaussians.sh_degree == 0
    assert gaussians.opacities[3] == pytest.approx(0.495) and (gaussians.opacities > 0.9).sum() == 41
    assert torch.allclose(0.5 + 0.28209479177387814 * gaussians.sh, torch.tensor(0.25))


def test_the_default_camera_sees_60_degrees():
    image, depth = np.zeros((30, 40, 3), np.float32), np.ones((30, 40))
    means = from_depth(image, depth).means
    edge = (means[:, 0].max() - means[:, 0].min()) / 2 * 40 / 39  # to the outer edge of the last pixel
    assert edge == pytest.approx(np.tan(np.radians(30)), rel=1e-5)
    assert focal_length_px(60, 40, 30) == pytest.approx(20 / np.tan(np.radians(30)))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 9), st.integers(1, 30), st.floats(-10, 10), st.floats(0.01, 30))
def test_any_depth_map_gives_valid_gaussians(seed, height, width, exponent, roughness):
    random = np.random.default_rng(seed)
    depth = 10.0**exponent * np.exp(roughness * random.normal(size=(height, width)))
    depth[random.random((height, width)) < 0.1] = random.choice([np.nan, np.inf, 0, -1])
    image = random.random((height, width, random.choice([3, 4]))).astype(np.float32)
    try:
        gaussians = from_depth(image, depth)
    except lf.InputError as error:
        assert "no opaque pixel" in str(error)
    else:
        gaussians.validate()


GOOD = np.full((4, 5, 3), 0.5, np.float32)


@pytest.mark.parametrize(
    "image, depth, options, words",
    [
        (GOOD[0], np.ones((4, 5)), {}, "photo.*H, W, 3"),
        (GOOD[..., :2], np.ones((4, 5)), {}, "photo"),
        ((GOOD * 255).astype(np.uint8), np.ones((4, 5)), {}, "255"),
        (GOOD * 3, np.ones((4, 5)), {}, "0..1"),
        (GOOD * np.nan, np.ones((4, 5)), {}, "finite"),
        (GOOD, np.ones((4, 5, 1)), {}, "depth.*H, W"),
        (GOOD, np.ones((4, 5), np.uint16), {}, "floating point"),
        (GOOD, np.ones((5, 4)), {}, "size 5 x 4, got 4 x 5"),
        (GOOD, np.zeros((4, 5)), {}, "no opaque pixel"),
        (GOOD, np.ones((4, 5)), {"focal_px": (1, 0)}, "> 0"),
        (GOOD, np.ones((4, 5)), {"focal_px": 3}, "two numbers"),
        (GOOD, np.ones((4, 5)), {"principal_point_px": (1, np.nan)}, "finite"),
        (np.zeros((4097, 4096, 3), np.float32), np.ones((4, 5)), {}, "smaller"),
    ],
)
def test_what_is_no_photo_with_depth_is_refused(image, depth, options, words):
    with pytest.raises(lf.InputError, match=words):
        from_depth(image, depth, **options)


@pytest.mark.parametrize("degrees", [0, 180, -3, float("nan")])
def test_fields_of_view_that_are_none(degrees):
    with pytest.raises(lf.InputError, match="between 0 and 180"):
        focal_length_px(degrees, 3, 4)


def test_what_is_no_margin_is_refused():
    with pytest.raises(lf.InputError, match="texture or blur"):
        lf.from_depth(np.zeros((4, 4, 3), np.float32), np.ones((4, 4), np.float32), margin="mirror")
