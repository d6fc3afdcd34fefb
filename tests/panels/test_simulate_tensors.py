"""What an eye sees, in torch, against NumPy and finite differences."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from panel_cases import template_panel

from lightfield_gs import InputError, Optics
from lightfield_gs.panels.simulate import simulate
from lightfield_gs.panels.simulate_tensors import simulate_with_gradients

PANEL = template_panel(48, 30, 48, phase=-310.4, viewing_distance_mm=600, pixel_pitch_mm=0.2)
CELLS = (((-0.31, 0.25), (0.28, 0.25), (0.0, -0.25)), ((-0.31, -0.25), (0.28, -0.25), (0.0, 0.25)))
PANELS = {
    "plain": PANEL,
    "inverted, BGR": replace(PANEL, invert_views=True, subpixel_order="BGR"),
    "cells": replace(PANEL, subpixel_cells=CELLS, cell_pattern=2, slant_tan=-0.2),
}
EYE = (70.0, 20.0, 560.0)


@pytest.mark.parametrize("name", PANELS)
def test_the_picture_is_that_of_numpy_also_by_given_numbers(name):
    panel = PANELS[name]
    image = np.random.default_rng(1).random((2, panel.height_px, panel.width_px, 3))
    found = simulate_with_gradients(torch.from_numpy(image), panel, EYE, 1.4)
    for mine, one in zip(found, image):
        np.testing.assert_allclose(mine, simulate(one, panel, EYE, 1.4), atol=2e-4)  # its phases are float32
    other = replace(panel, phase=3.1, slant_tan=0.1)
    np.testing.assert_allclose(
        simulate_with_gradients(torch.from_numpy(image[0]), panel, EYE, optics=Optics.of(other)).detach(),
        simulate(image[0], other, EYE),
        atol=2e-4,
    )


@pytest.mark.parametrize("name", PANELS)
def test_gradcheck_in_the_image_and_in_all_numbers_of_the_panel(name):
    panel = replace(PANELS[name], width_px=9, height_px=6)
    image = torch.rand(6, 9, 3, dtype=torch.float64, requires_grad=True)
    given = Optics.of(panel).given()

    def draw(image, *values):
        return simulate_with_gradients(image, panel, EYE, optics=Optics(**dict(zip(given, values))))

    assert torch.autograd.gradcheck(draw, (image, *given.values()), eps=1e-7, atol=1e-5, rtol=1e-5)


def test_what_it_cannot_see_is_refused():
    image = torch.zeros(30, 48, 3)
    for changed, words in (
        (dict(image=image.byte()), "expected float32 or float64 .*got torch.uint8"),
        (dict(image=image[1:]), r"\[..., 30, 48, 3\]"),
        (dict(eye_mm=(0, 0, -1)), "z is the distance"),
        (dict(panel=replace(PANEL, pixel_pitch_mm=None)), "lacks pixel_pitch_mm"),
        (dict(optics=Optics(line_number=torch.tensor(-1.0))), "line_number must be"),
    ):
        with pytest.raises(InputError, match=words):
            simulate_with_gradients(**(dict(image=image, panel=PANEL, eye_mm=EYE) | changed))
