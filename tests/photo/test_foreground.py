"""Edges of a cut-out have the object's own colour; the old background's is taken out where it is in them."""

import numpy as np
import pytest
from scipy import ndimage

from lightfield_gs.io.images import write_image
from lightfield_gs.photo.foreground import clean_edges, estimate_foreground, mix_edges
from lightfield_gs.photo.load import load_photo

SIZE = 96
ROWS, COLUMNS = np.mgrid[:SIZE, :SIZE] / SIZE
OWN = np.stack([0.2 + 0.5 * COLUMNS, 0.3 + 0 * ROWS, 0.7 - 0.4 * ROWS], 2).astype(np.float32)
ALPHA = ndimage.gaussian_filter((np.hypot(ROWS - 0.5, COLUMNS - 0.5) < 0.35).astype(np.float32), 1.5).clip(0, 1)
ALPHA[ALPHA < 0.002], ALPHA[ALPHA > 0.998] = 0, 1
EDGE = (ALPHA > 0.1) & (ALPHA < 0.9)


def over(background) -> np.ndarray:
    return (ALPHA[..., None] * OWN + (1 - ALPHA[..., None]) * np.asarray(background)).astype(np.float32)


def error(rgb: np.ndarray) -> float:
    values = rgb / 255.0 if rgb.dtype == np.uint8 else rgb
    return float(np.sqrt(((values - OWN)[EDGE] ** 2).mean()))


HALVES = np.where(COLUMNS < 0.5, 1.0, 0.1)[..., None]


@pytest.mark.parametrize("background, most", [((1, 1, 1), 0.03), ((0.1, 0.6, 0.2), 0.03), (HALVES, 0.1)])
def test_colours_of_the_object_are_found_in_mixtures(background, most):
    photo = over(background)
    assert error(estimate_foreground(photo, ALPHA)[0]) < most < error(photo)
    assert clean_edges(photo, ALPHA, has_background=True) and error(photo) < most
    large = np.round(255 * over(background)).astype(np.uint8).repeat(15, 0).repeat(15, 1)
    assert clean_edges(large, ALPHA.repeat(15, 0).repeat(15, 1), has_background=True)
    assert error(large[7::15, 7::15]) < 1.5 * most


@pytest.mark.parametrize("background", [(1, 1, 1), (0, 0, 0), (0.1, 0.6, 0.2), HALVES])
def test_a_cut_out_tells_whether_its_edges_carry_the_background(background):
    photo = over(background)
    hidden = np.where(ALPHA[..., None] > 0, photo, photo if background is HALVES else 0.0).astype(np.float32)
    assert clean_edges(hidden, ALPHA, has_background=False) and error(hidden) < 0.1
    clean = np.where(ALPHA[..., None] > 0, OWN, np.asarray(background)).astype(np.float32)
    kept = clean.copy()
    assert not clean_edges(kept, ALPHA, has_background=False) and np.array_equal(kept, clean)


@pytest.mark.parametrize("backdrop", [(0.95, 0.95, 0.95), (0.1, 0.7, 0.2)])
def test_alpha_of_an_edge_is_the_share_of_a_mixture(backdrop):
    photo, colours = over(backdrop), np.zeros((3, 3), np.float32)
    colours[0] = backdrop
    by_distance = ((np.linalg.norm(photo - backdrop, axis=2) - 0.06) / 0.08).clip(0, 1).astype(np.float32)
    mixed = by_distance.copy()
    mix_edges(photo, mixed, colours)
    errors = [np.abs(alpha - ALPHA)[EDGE].mean() for alpha in (mixed, by_distance)]
    assert errors[0] < 0.6 * errors[1]


def test_a_dark_halo_is_background_and_a_drawn_outline_is_not():
    grey, colours = np.full(3, 0.5, np.float32), np.zeros((3, 3), np.float32)
    colours[0] = grey
    radius = np.hypot(ROWS - 0.5, COLUMNS - 0.5)
    ring, inside = (radius >= 0.35) & (radius < 0.37), radius < 0.31
    for outline, least, most in ((0.4, 0.0, 0.2), (0.0, 0.95, 1.0)):
        photo = np.where((radius < 0.35)[..., None], (0.9, 0.4, 0.3), grey).astype(np.float32)
        photo[ring] = outline
        alpha = (radius < 0.37).astype(np.float32)
        mix_edges(photo, alpha, colours)
        assert least <= alpha[ring].mean() <= most and (alpha[inside] == 1).all()


def test_photos_are_cleaned_as_they_are_read(tmp_path):
    levels = np.round(255 * np.dstack([over((1, 1, 1)), ALPHA])).astype(np.uint8)
    write_image(tmp_path / "photo.png", levels)
    assert error(load_photo(tmp_path / "photo.png")[..., :3]) < 0.03
    assert np.array_equal(load_photo(tmp_path / "photo.png", clean_edges=False), levels / np.float32(255))
    write_image(tmp_path / "rgb.png", levels[..., :3])
    write_image(tmp_path / "mask.png", levels[..., 3:])
    assert error(load_photo(tmp_path / "rgb.png", tmp_path / "mask.png")[..., :3]) < 0.03
