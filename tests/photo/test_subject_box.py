"""A photo on a panel of another shape: cover about its subject, or the whole photo before a blurred continuation."""

from dataclasses import replace

import pytest
import torch

import lightfield_gs as lf
from lightfield_gs.base.options import Fit
from lightfield_gs.photo.margin import extend_with_margin, fit_to_panel
from lightfield_gs.photo.subject import subject_box

HEIGHT, WIDTH = 120, 180


def on_the_ground(left: int, right: int, top: int = 30, bottom: int = 90) -> torch.Tensor:
    """Depths of a ground that comes nearer towards the bottom, and of a thing that stands on it."""
    rows = torch.arange(HEIGHT, dtype=torch.float32)[:, None].expand(HEIGHT, WIDTH)
    disparity = 0.2 + 0.4 * rows / HEIGHT
    disparity = disparity.clone()
    disparity[top:bottom, left:right] = 0.2 + 0.4 * bottom / HEIGHT + 0.05
    return 1 / disparity


def fitted(depth: torch.Tensor, width_px: int, height_px: int, fit: Fit = "auto", about_middle: bool = False):
    panel = replace(lf.Panel.load("toy-8v"), width_px=width_px, height_px=height_px)
    middle = WIDTH / 2, HEIGHT / 2
    return panel, fit_to_panel(depth, (150.0, 150.0), middle, panel, fit, about_middle=about_middle)


@pytest.mark.parametrize("left, right", [(80, 120), (20, 60), (10, 170)])
def test_the_subject_is_what_stands_on_the_ground(left, right):
    box = subject_box(on_the_ground(left, right))
    assert box is not None
    assert left - 12 <= box[0] <= left and right <= box[2] <= right + 12 and box[1] <= 32 and 80 <= box[3] <= 100


def test_a_plane_has_no_subject():
    assert subject_box(on_the_ground(0, 0)) is None
    assert subject_box(torch.full((HEIGHT, WIDTH), 2.0)) is None
    assert subject_box(torch.full((HEIGHT, WIDTH), torch.nan)) is None


def test_a_photo_is_cropped_about_its_subject():
    panel, placed = fitted(on_the_ground(20, 60), 70, 100)
    assert placed.fit == "cover" and placed.cropped > 0.5 and placed.made_up == 0
    scale = panel.height_px / HEIGHT
    left, right = (scale * (x - WIDTH / 2) + placed.rig.principal_point_px[0] for x in (20, 60))
    assert left >= 0 and right <= panel.width_px
    # Nothing of the photo is missing beside it, and explicit options keep the middle
    assert scale * (0 - WIDTH / 2) + placed.rig.principal_point_px[0] <= 0.01
    assert fitted(on_the_ground(20, 60), 70, 100, "cover")[1].rig.principal_point_px[0] == pytest.approx(35)


def test_pictures_in_a_row_are_cropped_about_their_middle_if_the_subject_is_there():
    in_the_middle, beside = (fitted(on_the_ground(*at), 70, 100, "auto", True)[1] for at in ((75, 105), (20, 60)))
    assert in_the_middle.fit == "cover" and in_the_middle.rig.principal_point_px[0] == pytest.approx(35)
    assert beside.fit == "contain"


def test_a_subject_as_wide_as_the_photo_is_shown_whole():
    _, placed = fitted(on_the_ground(10, 170), 70, 100)
    assert placed.fit == "contain" and placed.cropped == 0 and placed.made_up > 0.4
    assert fitted(on_the_ground(10, 170), 160, 100)[1].fit == "cover"
    # Without a subject a third is cropped at most
    assert [fitted(on_the_ground(0, 0), width, 100)[1].fit for width in (105, 90)] == ["cover", "contain"]


def test_a_subject_that_the_photo_cuts_off_may_be_cropped_by_a_third():
    close = on_the_ground(30, 130, 0, HEIGHT)
    close[:, 30:130] -= 0.3
    assert [fitted(close, 180, height)[1].fit for height in (90, 70)] == ["cover", "contain"]


def test_a_blurred_margin_is_a_darker_continuation_that_repeats_nothing():
    image = torch.full((HEIGHT, WIDTH, 3), 0.5)
    image[40:80, 60:120] = torch.tensor([1.0, 0.8, 0.0])
    image[::2, ::2] -= 0.2
    colours, z, outside = extend_with_margin(image, torch.full((HEIGHT, WIDTH), 2.0), (0, 90, 0, 90), "blur")
    assert torch.equal(colours[90:-90], image) and torch.allclose(z, torch.tensor(2.0))
    margin = colours[outside].reshape(-1, 3)
    assert float((margin[:, 0] - margin[:, 2]).abs().max()) < 0.1  # nothing yellow
    assert float(colours[89].mean()) > 0.4 > 0.26 > float(colours[:30].mean())
    assert float(colours[:60].std()) < 0.03
