"""Ordinary images of many views without gradients: the same bits in any parts, and what memory they take."""

from __future__ import annotations

import pytest
import torch
from rasterizer_cases import panel, random_scene
from sorted_cases import toe_in

from lightfield_gs import render
from lightfield_gs.rasterizer import image_render
from lightfield_gs.rasterizer.images import RenderedImages

VIEWS, GAUSSIANS, WIDTH, HEIGHT = 24, 1500, 60, 44


def case():
    shown = panel(width_px=WIDTH, height_px=HEIGHT, views=VIEWS)
    return random_scene(GAUSSIANS, 1, seed=3).to(torch.float32), toe_in(shown, VIEWS)


def peak_bytes(draw) -> int:
    """The most memory that torch holds at a time while `draw` runs, beside what it held before."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
        held = draw()
    events = sorted(profile.profiler.kineto_results.events(), key=lambda event: event.start_ns())
    changes = torch.tensor([event.nbytes() for event in events if event.name() == "[memory]"])
    del held
    return int(changes.cumsum(0).max())


def assert_equal(a: RenderedImages, b: RenderedImages) -> None:
    """Assert that both have the same fields, with the same bits."""
    for name, first, second in zip(a._fields, a, b):
        assert (first is None) == (second is None), name
        assert first is None or torch.equal(first, second), name


@pytest.mark.parametrize("alpha, depth", [(False, False), (True, False), (False, True), (True, True)])
def test_parts_are_the_whole(alpha, depth, monkeypatch):
    scene, cameras = case()
    whole = render(scene, cameras, alpha=alpha, depth=depth)
    monkeypatch.setattr(image_render, "CHUNK_BYTES", 5 * 4 * image_render._SPLAT_NUMBERS * GAUSSIANS)
    parts = render(scene, cameras, alpha=alpha, depth=depth)
    assert_equal(whole, parts)
    with torch.enable_grad():  # by the operator that has a reverse
        followed = type(scene)(*(field.clone().requires_grad_() for field in scene.fields().values()))
        assert_equal(render(followed, cameras, alpha=alpha, depth=depth), parts)


@pytest.mark.parametrize("alpha, depth", [(False, False), (False, True), (True, True)])
def test_memory_is_that_of_the_images_and_of_a_view(alpha, depth, monkeypatch):
    """Beside the images no more than 192 bytes a Gaussian and 8 a pixel of one view, whatever the number of views."""
    scene, cameras = case()
    monkeypatch.setattr(image_render, "CHUNK_BYTES", 1)
    kept = 12 + 4 * (alpha or depth) + 4 * depth
    bound = VIEWS * WIDTH * HEIGHT * kept + 192 * GAUSSIANS + 8 * WIDTH * HEIGHT + 20_000
    used = peak_bytes(lambda: render(scene, cameras, alpha=alpha, depth=depth))
    assert VIEWS * WIDTH * HEIGHT * kept < used <= bound
    monkeypatch.undo()
    assert peak_bytes(lambda: render(scene, cameras, alpha=alpha, depth=depth)) > 2 * bound
