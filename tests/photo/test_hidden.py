"""The hidden parts of a photo with depths, its soft outlines, and invented pixels around it: against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import lightfield_gs as lf
from lightfield_gs.photo import inpainting
from lightfield_gs.photo.depth_edges import coverage_to_opacity, edges, find_matte
from lightfield_gs.photo.hidden import fill_hidden, find_hidden
from lightfield_gs.photo.inpainting import complete, solve_membrane
from lightfield_gs.photo.margin import extend_with_margin, fit_to_panel
from lightfield_gs.photo.rgbd import from_depth

HEIGHT, WIDTH, FOCAL = 90, 150, 130.0
ROWS, COLUMNS = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
SQUARE = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
SQUARE[30:60, 60:90] = True
PLANE = 1 / (0.3 + 0.0004 * COLUMNS + 0.0003 * ROWS)  # z of a slanted plane: its disparity is linear


def before_the_plane(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """A red square at z = 1 before the plane with these colours: photo and depths."""
    return torch.where(SQUARE[..., None], torch.tensor([1.0, 0, 0]), image), torch.where(SQUARE, 1.0, PLANE)


@pytest.mark.parametrize("slope", [0.0, 0.003])
def test_a_plane_goes_on_behind_a_square(slope):
    """In depth, slanted as it is; in colour, where that is constant or a linear gradient."""
    image = torch.stack([0.2 + slope * COLUMNS, 0.3 + slope * ROWS, torch.full_like(ROWS, 0.5)], 2)
    found = find_hidden(*before_the_plane(image), (FOCAL, FOCAL))
    behind = found.hole & SQUARE
    assert (behind == SQUARE).all()  # a camera at the end of the cone sees all of it
    assert torch.allclose(found.disparity[behind], 1 / PLANE[behind], rtol=5e-3)
    colours = fill_hidden(found, PLANE)
    assert (colours - image)[behind].abs().mean() < 0.01 + 3 * slope  # a patch is a step of the gradient off, no more
    assert colours[behind][:, 0].max() < 0.75  # nothing of the red square


def test_a_texture_goes_on_as_a_texture():
    """Stripes of 6 pixels behind the square: as strong as beside it, where a smooth filling has none."""
    image = (0.5 + 0.4 * torch.sin(COLUMNS * 2 * math.pi / 6))[..., None].expand(-1, -1, 3).contiguous()
    found = find_hidden(*before_the_plane(image), (FOCAL, FOCAL))
    colours = fill_hidden(found, PLANE)
    inner = slice(35, 55), slice(65, 85)
    assert colours[inner].std() > 0.8 * image[inner].std()
    assert (colours - image)[inner].abs().mean() < 0.15


def test_a_slanted_plane_is_not_hidden_where_it_comes_into_view_again():
    """It does so nearer to the camera than it went out of view."""
    plane = 1 / (0.3 + 0.002 * COLUMNS)
    found = find_hidden(torch.zeros(HEIGHT, WIDTH, 3), torch.where(SQUARE, 1.0, plane), (FOCAL, FOCAL))
    assert found.hole[SQUARE].all() and not found.hole[30:60, 94:].any()


def test_a_hidden_surface_is_smooth_where_depths_are_noisy():
    """Rows that differ by 3 % are one surface: in between, Gaussians would be needles."""
    noise = 0.03 * torch.rand(HEIGHT, 1, generator=torch.Generator().manual_seed(3))
    found = find_hidden(torch.zeros(HEIGHT, WIDTH, 3), torch.where(SQUARE, 1.0, PLANE * (1 + noise)), (FOCAL, FOCAL))
    middle = found.disparity[35:55, 70:80].log()
    assert middle.diff(dim=0).abs().mean() < 0.15 * noise.log1p().diff(dim=0).abs().mean()


def test_without_edges_nothing_is_hidden():
    found = find_hidden(torch.zeros(HEIGHT, WIDTH, 3), PLANE, (FOCAL, FOCAL))
    assert not found.hole.any() and from_depth(torch.zeros(HEIGHT, WIDTH, 3), PLANE).count == HEIGHT * WIDTH


def test_the_alpha_of_a_blurred_edge_is_recovered():
    """A straight edge smoothed over four pixels between two plain colours, its depth map a hard step."""
    true = (1 / (1 + torch.exp(-(COLUMNS - 75) / 0.8)))[..., None]
    near, far = torch.tensor([0.9, 0.2, 0.1]), torch.tensor([0.1, 0.4, 0.8])
    image = true * near + (1 - true) * far
    depth = torch.where(COLUMNS > 75, 1.0, 2.5)
    matte = find_matte(image, depth, edges(depth, (FOCAL, FOCAL)))
    assert set(matte.columns.tolist()) == set(range(73, 77)) or len(set(matte.columns.tolist())) >= 4
    assert torch.allclose(matte.alpha, true[matte.rows, matte.columns, 0], atol=0.06)
    assert torch.allclose(matte.near[matte.alpha > 0.1], near.expand(3), atol=0.1)
    again = matte.alpha[:, None] * matte.near + (1 - matte.alpha[:, None]) * matte.far
    assert torch.allclose(again, image[matte.rows, matte.columns], atol=0.03)


def test_opacities_cover_as_much_as_they_should():
    """A field of Gaussians, one per pixel, all of the opacity for a coverage of a half, covers a half."""
    wanted = torch.tensor([0.0, 0.25, 0.5, 0.9, 1.0])
    opacity = coverage_to_opacity(wanted, 0.65, 0.99)
    offsets = torch.arange(-4, 5).double()
    kernel = torch.exp(-(offsets[:, None] ** 2 + offsets**2) / 2 / 0.65**2)
    covered = 1 - (1 - opacity.double()[:, None, None] * kernel).prod(2).prod(1)
    assert torch.allclose(covered, wanted.double(), atol=2e-3)


@pytest.mark.parametrize("fit, pan", [("cover", (0, 0)), ("contain", (0, 0)), ("cover", (0.3, -0.2))])
def test_all_views_are_covered(fit, pan):
    """On a panel of another shape no view of the cone shows anything but the scene."""
    image = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    image, depth = before_the_plane(image * 0.3 + 0.3)
    panel = replace(lf.Panel.load("toy-8v"), width_px=100, height_px=140)
    placed = fit_to_panel(depth, (FOCAL, FOCAL), (WIDTH / 2, HEIGHT / 2), panel, fit, pan=pan)
    assert (placed.cropped > 0.5) == (fit == "cover") and (placed.made_up > 0.4) == (fit == "contain")
    gaussians = from_depth(image, depth, (FOCAL, FOCAL), margin_px=placed.margin_px)
    x, y = placed.rig.principal_point_px
    rig = replace(placed.rig, principal_point_px=(x + pan[0] * panel.width_px, y + pan[1] * panel.height_px))
    alphas = lf.render(gaussians, rig.cameras_at(panel, [0.0, 4.0, 8.0]), alpha=True).alpha
    assert (alphas < 0.9).float().mean() < 0.002


def test_the_margin_of_a_plane_is_the_plane():
    image = torch.full((20, 30, 3), 0.4)
    colours, z, outside = extend_with_margin(image, torch.full((20, 30), 2.0), (7, 5, 3, 1))
    assert colours.shape == (26, 40, 3) and not outside[5:25, 7:37].any() and outside.sum() == 26 * 40 - 600
    assert torch.allclose(colours, torch.tensor(0.4)) and torch.allclose(z, torch.tensor(2.0))


def test_what_is_no_fit_is_refused():
    with pytest.raises(lf.InputError, match="cover or contain"):
        fit_to_panel(PLANE, (FOCAL, FOCAL), (75, 45), lf.Panel.load("toy-8v"), "stretch")


def test_the_same_photo_gives_the_same_filling():
    random = np.random.default_rng(2)
    image = torch.from_numpy(random.random((60, 60, 3), np.float32))
    hole = torch.zeros(60, 60, dtype=torch.bool)
    hole[20:40, 25:35] = True
    one, other = (complete(image.clone(), hole, ~hole, torch.zeros(60, 60)) for _ in range(2))
    assert torch.equal(one, other) and torch.isfinite(one).all()


def test_a_large_hole_is_filled_in_few_steps(monkeypatch):
    """A gradient continues in a hole of 300 x 300 pixels, from a blank first guess.

    It takes a few steps in the full picture, however large the hole is.
    """
    taken: dict[int, int] = {}
    steps = inpainting._conjugate_gradients

    def counted(apply, right, guess, diagonal, iterations):
        taken[len(guess)] = iterations
        return steps(apply, right, guess, diagonal, iterations)

    monkeypatch.setattr(inpainting, "_conjugate_gradients", counted)
    rows, columns = torch.meshgrid(torch.arange(340) / 340, torch.arange(360) / 360, indexing="ij")
    gradient = torch.stack([rows, columns, 0.5 * rows + 0.2], 2)
    hole = torch.zeros(340, 360, dtype=torch.bool)
    hole[20:320, 30:330] = True
    linked = [torch.ones(339, 360, dtype=torch.bool), torch.ones(340, 359, dtype=torch.bool)]
    filled_in = solve_membrane(torch.where(hole[..., None], 0.5, gradient), hole, linked)
    assert (filled_in - gradient).abs().max() < 0.02
    assert taken[90000] <= 10 and sum(size * count for size, count in taken.items()) < 25 * 90000


def test_large_holes_cost_matches_of_a_small_picture(monkeypatch):
    """Four times the pixels take no more patches; texture is copied from where it is, not blurred."""
    counts = []
    for size in (300, 600):
        places, cost = [], inpainting._Matches._cost
        monkeypatch.setattr(inpainting, "_Matches", type("Counted", (inpainting._Matches,), {}))
        monkeypatch.setattr(
            inpainting._Matches,
            "_cost",
            lambda self, m, w, cost=cost, places=places: (places.append(len(w)), cost(self, m, w))[1],
        )
        columns = torch.arange(size).expand(size, size)
        image = (0.5 + 0.4 * torch.sin(columns * 2 * math.pi / 24))[..., None].expand(-1, -1, 3).contiguous()
        hole = torch.zeros(size, size, dtype=torch.bool)
        hole[size // 4 : -size // 4, size // 4 : -size // 4] = True
        said = complete(torch.where(hole[..., None], 0.5, image), hole, ~hole, torch.zeros(size, size))
        assert said[hole].std() > 0.8 * image[hole].std()
        counts.append(sum(places))
    assert counts[1] < 1.5 * counts[0]


def test_any_number_of_threads_gives_the_same_scene():
    image = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    image, depth = before_the_plane(image)
    before = torch.get_num_threads()
    try:
        scenes = []
        for threads in (1, 3):
            torch.set_num_threads(threads)
            scenes.append(from_depth(image, depth, (FOCAL, FOCAL), margin_px=(20, 0, 20, 0)))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(scenes[0].means, scenes[1].means) and torch.equal(scenes[0].sh, scenes[1].sh)
