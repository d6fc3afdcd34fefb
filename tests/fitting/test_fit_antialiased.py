"""A fit with anti-aliasing: renders, and their gradients."""

from __future__ import annotations

import math

import torch
from fit_scene import first_state, known_cameras, known_scene, photograph_scene

import lightfield_gs as lf
from lightfield_gs.fitting.settings import FitSettings
from lightfield_gs.fitting.trainer import Trainer


def test_a_fit_draws_as_its_settings_say():
    """Small Gaussians, which without anti-aliasing are drawn larger: the fit that draws as the photographs were drawn
    comes nearer to them, by pictures with anti-aliasing."""
    scene = known_scene()
    scene.scales = scene.scales * 0.4
    cameras = known_cameras()
    pictures = lf.render(scene, cameras, background=(0.0, 0.0, 0.0), antialiased=True).image.clamp(0, 1)
    images = photograph_scene(scene)
    images.photos = pictures.mul(255).round().to(torch.uint8)
    scores = {}
    for antialiased in (False, True):
        settings = FitSettings(steps=200, cap_max=300, sh_degree=0, antialiased=antialiased, init_scale=0.1)
        trainer = Trainer(first_state(scene, settings, 300), images, settings)
        for done in (0, settings.steps):
            trainer.advance(done)
            image = lf.render(trainer.state.gaussians(), cameras, background=(0.0, 0.0, 0.0), antialiased=True).image
            scores[antialiased, done] = -10 * math.log10(float((image - pictures).square().mean()))
    assert scores[True, 200] > scores[True, 0] + 3
    assert scores[True, 200] > scores[False, 200] + 0.5
