"""Scores of what eyes across the cone see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterizer_cases import random_scene, rig

from lightfield_gs import InputError, Panel, encode
from lightfield_gs.panels.simulate import simulate, zone_width_mm
from lightfield_gs.reference.eyes import EyeReference, eyes_across, view_coordinates

PANEL = replace(Panel.load("toy-8v"), width_px=160, height_px=80)


@pytest.mark.parametrize("invert", [False, True])
def test_eyes_see_the_views_they_are_said_to(invert):
    panel = replace(PANEL, views=64, invert_views=invert)
    eyes = eyes_across(panel, 7)
    assert eyes[0, 0] == pytest.approx(-0.375 * zone_width_mm(panel)) and (eyes[:, 2] == 1000).all()
    for eye, x in zip(eyes, view_coordinates(panel, eyes)):
        seen = simulate(panel.view_map(continuous=True) / panel.views, panel, eye.tolist(), 0.6)
        assert panel.views * seen[2:-2, 2:-2].mean() == pytest.approx(x, abs=0.02 * panel.views)


def test_exact_views_score_best_and_eyes_between_views_worse():
    scene = random_scene(200, size=0.02, seed=3, dtype=torch.float32)
    fan, eyes = rig(PANEL), eyes_across(PANEL, 13)
    reference = EyeReference(scene, PANEL, fan, eyes)
    scores = list(reference.scores(encode(scene, PANEL, fan, output="float32").clamp(0, 1).numpy()))
    assert [score.right_mm for score in scores] == eyes[:, 0].tolist()
    between = [abs(score.view % 1 - 0.5) > 0.4 for score in scores]
    psnr, ssim = (np.array([getattr(score, name) for score in scores]) for name in ("psnr_db", "ssim"))
    assert psnr[~np.array(between)].min() > psnr[between].max() + 3 and ssim.max() <= 1
    mirrored = encode(scene, replace(PANEL, invert_views=True), fan, output="float32").clamp(0, 1).numpy()
    assert max(score.psnr_db for score in reference.scores(mirrored)) < psnr.max() - 3


def test_the_filter_helps_eyes_between_views_of_small_splats():
    panel = replace(PANEL, width_px=320, height_px=160, cone_deg=40.0)
    scene = random_scene(600, size=0.01, seed=3, dtype=torch.float32)
    fan = rig(panel)
    border = eyes_across(panel, 13)[::2]  # where two views meet
    reference = EyeReference(scene, panel, fan, border)
    sharp, filtered = (
        [score.psnr_db for score in reference.scores(image.clamp(0, 1).numpy())]
        for image in (encode(scene, panel, fan, output="float32", view_filter=width) for width in (0.0, 1.0))
    )
    assert np.mean(filtered) > np.mean(sharp)


def test_a_panel_without_a_place_for_eyes_is_refused():
    with pytest.raises(InputError, match="lacks viewing_distance_mm"):
        eyes_across(replace(PANEL, viewing_distance_mm=None), 3)
