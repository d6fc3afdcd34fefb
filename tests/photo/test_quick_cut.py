"""Objects cut out of pictures in a row: their edges and colours against what the pictures were mixed of."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from lightfield_gs import InputError
from lightfield_gs.photo.quick_cut import cut_along, find_outline

ROWS, COLUMNS = np.mgrid[:270, :480]


def mixed(background, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A picture with noise, the share 0..1 of the object in each pixel, and the object's colours."""
    disc = (np.hypot(ROWS - 140, COLUMNS - 250) < 80) | (np.hypot(ROWS - 140, COLUMNS - 330) < 30)
    share = ndimage.gaussian_filter(disc.astype(float), 1.2)
    own = np.stack([150 + 60 * np.sin(COLUMNS / 20), 50 + 30 * np.cos(ROWS / 15), 40 + 0 * ROWS], 2)
    picture = share[..., None] * own + (1 - share[..., None]) * background
    noise = np.random.default_rng(seed).normal(0, 1.5, picture.shape)
    return (picture + noise).round().clip(0, 255).astype(np.uint8), share, own


SLOPE = np.stack([190 + 25 * COLUMNS / 480, 200 + 20 * ROWS / 270, 235 + 0 * ROWS], 2)


@pytest.mark.parametrize("background", [(235, 235, 235), (20, 160, 40), SLOPE], ids=["grey", "green", "slope"])
def test_shares_and_colours_are_those_of_the_mixture(background):
    picture, share, own = mixed(background)
    outline = find_outline(picture, "film")
    rgba = cut_along(torch.from_numpy(picture), outline).numpy().astype(float)
    alpha = rgba[..., 3:] / 255
    edge = (share > 0.05) & (share < 0.95)
    assert np.abs(alpha[..., 0] - share)[edge].mean() < 0.08
    assert np.abs(alpha[..., 0] - share)[~edge].max() < 0.1
    elsewhere = np.array([30, 30, 60])
    found = alpha * rgba[..., :3] + (1 - alpha) * elsewhere
    true = share[..., None] * own + (1 - share[..., None]) * elsewhere
    assert np.abs(found - true)[edge].mean() < 10  # with the old background it is many times as much
    box = outline.box(*share.shape)
    np.testing.assert_array_equal(cut_along(torch.from_numpy(picture), outline, box).numpy(), rgba[box])
    assert np.isclose(alpha[box].sum(), alpha.sum())  # nothing of it is beyond


def test_pictures_without_an_object_or_a_plain_background_are_refused():
    with pytest.raises(InputError, match="film.*nothing stands out"):
        find_outline(np.full((270, 480, 3), 235, np.uint8), "film")
    with pytest.raises(InputError, match="film.*no plain background"):
        find_outline(np.stack([COLUMNS // 2, ROWS // 2, ROWS // 3], 2).astype(np.uint8), "film")
