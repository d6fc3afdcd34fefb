"""Scores of held-out photographs against their definition, written out here."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from fit_scene import known_cameras, known_scene, photograph_scene

import lightfield_gs as lf
from lightfield_gs.fitting.evaluate import Scores, evaluate, match_colours, weighted_psnr_db
from lightfield_gs.fitting.progress import side_by_side
from lightfield_gs.reference.metrics import ssim

BLACK = (0.0, 0.0, 0.0)


def test_scores_are_those_of_the_definition():
    other, images = known_scene(seed=1), photograph_scene(known_scene())
    scores = evaluate(other, images, BLACK)
    drawn = lf.render(other, known_cameras(), background=BLACK).image.clamp(0, 1)
    photos = images.photos / 255
    psnr = [-10 * math.log10(float((d - p).double().square().mean())) for d, p in zip(drawn, photos)]
    assert scores.psnr_db == pytest.approx(psnr, abs=1e-4)
    assert scores.ssim == pytest.approx(ssim(drawn.permute(0, 3, 1, 2), photos.permute(0, 3, 1, 2)).tolist(), abs=1e-5)
    assert scores.names == images.names and scores.mean_psnr_db == pytest.approx(sum(psnr) / len(psnr), abs=1e-4)


def test_what_a_mask_leaves_out_says_nothing():
    other, images = known_scene(seed=1), photograph_scene(known_scene())
    weights = torch.full(images.photos.shape[:3], 255, dtype=torch.uint8)
    weights[:, :, :16] = 0
    spoiled = images.photos.clone()
    spoiled[:, :, :16] = 200
    one, two = (evaluate(other, replace(images, photos=p, weights=weights), BLACK) for p in (images.photos, spoiled))
    assert one == two != evaluate(other, images, BLACK)


def test_a_plain_error_has_its_psnr():
    image = torch.full((4, 5, 3), 0.6)
    assert weighted_psnr_db(image, image - 0.1, torch.ones(4, 5)) == pytest.approx(20, abs=1e-4)
    assert weighted_psnr_db(image, image, torch.ones(4, 5)) == 100


def test_matched_colours_leave_out_exposure_and_masked_pixels():
    generator = torch.Generator().manual_seed(1)
    image, weights = 0.2 + 0.5 * torch.rand(6, 7, 3, generator=generator), torch.ones(6, 7)
    change = torch.tensor([[0.9, 0.05, 0.0], [0.1, 0.8, 0.02], [0.0, 0.03, 1.1]])
    photo = (image @ change + torch.tensor([0.02, -0.01, 0.03])).clamp(0, 1)
    photo[2:4], weights[2:4] = 1, 0  # a mask leaves them out
    matched = match_colours(image, photo, weights)
    torch.testing.assert_close(matched[weights > 0], photo[weights > 0], atol=1e-3, rtol=0)

    flat = torch.full((6, 7, 3), 0.25)  # of one colour: any change to one colour suits, none is singular
    torch.testing.assert_close(match_colours(flat, 2 * flat, torch.ones(6, 7)), 2 * flat, atol=1e-3, rtol=0)


def test_a_smaller_photograph_is_judged_in_its_own_frame():
    """It stands in the upper left of the size that all have."""
    images = photograph_scene(known_scene())
    small = replace(images, sizes=[(30, 20)] * images.count)
    edge = images.photos.clone()
    edge[:, 20:], edge[:, :, 30:] = 255, 255
    assert evaluate(known_scene(seed=1), replace(small, photos=edge), BLACK) == evaluate(
        known_scene(seed=1), small, BLACK
    )


def test_a_table_has_a_row_for_each_and_one_of_means():
    rows = Scores(["a/1.png", "b.png"], [20.0, 30.0], [0.5, 0.7]).table().splitlines()
    assert [row.split() for row in rows[1:]] == [
        ["a/1.png", "20.00", "0.5000"],
        ["b.png", "30.00", "0.7000"],
        ["mean", "25.00", "0.6000"],
    ]


def test_a_picture_shows_view_photograph_and_four_times_their_difference():
    image, photo, weights = torch.full((2, 3, 3), 0.5), torch.full((2, 3, 3), 0.4), torch.ones(2, 3)
    weights[:, 0] = 0
    found = side_by_side(image, photo, weights)
    assert found.shape == (2, 9, 3)
    assert found[0, :, 0].tolist() == pytest.approx([0.5] * 3 + [0.4] * 3 + [0, 0.4, 0.4], abs=1e-6)
