"""What shows itself in a notebook: the right things in the right places, small, escaped, and honest about the rest."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from subject_cases import floaters, joined, thing

from lightfield_gs import Cameras, FitResult, Gaussians, InputError, NotebookPicture, Panel, Rig, render
from lightfield_gs.base.harmonics import SH_CONSTANT
from lightfield_gs.fitting.cone import Display
from lightfield_gs.fitting.evaluate import Scores
from lightfield_gs.fitting.settings import FitSettings

RED, GREEN, BLUE, ORANGE = (0.9, 0.1, 0.1), (0.1, 0.8, 0.1), (43, 108, 176), (221, 107, 32)


def balls(places, colours) -> Gaussians:
    """Opaque balls of one size."""
    means = torch.tensor(places, dtype=torch.float32)
    sh = (torch.tensor(colours)[:, None] - 0.5) / SH_CONSTANT
    quaternions = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1)
    return Gaussians(means, quaternions, torch.full_like(means, 0.2), torch.full((len(means),), 0.99), sh)


def place(picture: np.ndarray, colour) -> tuple[float, int]:
    """The mean column of the pixels near a colour (0..255), and their number."""
    near = np.abs(picture.astype(int) - np.array(colour)).max(-1) < 60
    return float(np.nonzero(near)[1].mean()) if near.any() else math.nan, int(near.sum())


def test_a_turn_begins_behind_and_passes_the_front_and_the_right():
    scene = balls([[-0.5, 0, 3], [0.5, 0, 3]], [RED, GREEN])
    red, green = (np.array(colour) * 255 for colour in (RED, GREEN))
    back, left, front, right, end = NotebookPicture.of_gaussians(scene, 4).frames
    assert place(front, red)[0] < 180 and place(front, green)[0] > 220
    assert place(back, red)[0] > 220 and place(back, green)[0] < 180
    assert np.array_equal(back, end)
    # From the right, where +x is, the green ball hides the red one
    assert place(right, green)[1] > 500 and place(right, red)[1] == 0
    assert place(left, red)[1] > 500 and place(left, green)[1] == 0
    assert place(scene.show().frames[12], red)[0] < 180  # rests in front


def test_a_subject_is_drawn_without_what_is_far_around_it():
    alone, among = thing(), joined(thing(), floaters(300, 20, 60))
    shown = NotebookPicture.of_gaussians(among)
    assert "the subject alone is drawn" in shown.facts
    assert np.array_equal(shown.frames, NotebookPicture.of_gaussians(alone).frames)


def test_many_gaussians_are_thinned_and_that_is_said():
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(200_000, 3, generator=generator)
    sizes, grey = torch.full((200_000, 3), 0.01), torch.zeros(200_000, 1, 3)
    scene = Gaussians(places, torch.ones(200_000, 4), sizes, torch.ones(200_000), grey)
    shown = NotebookPicture.of_gaussians(scene)
    assert int(re.search(r"; (\d+) of them are drawn", shown.facts)[1]) <= 60_000
    assert place(shown.frames[0], (128, 128, 128))[1] > 100 * 100  # and they still cover the scene


def test_sub_pixels_have_the_colours_of_their_views():
    for panel in (Panel(200, 100, 7, 8.3, 0.2), Panel(30, 10, 7, 8.3, 0.2, subpixel_order="BGR", invert_views=True)):
        (picture,) = NotebookPicture.of_panel(panel).frames
        rows, columns = min(24, panel.height_px), min(48, panel.width_px)
        assert picture.shape == (9 * rows, 9 * columns, 3)
        views = panel.view_map()[:rows, :columns]
        views = (views if panel.subpixel_order == "RGB" else views[..., ::-1]).reshape(rows, 3 * columns)
        stripes = picture[4::9, 1::3]
        assert (stripes[views == 0] == BLUE).all() and (stripes[views == 6] == ORANGE).all()
        assert np.abs(stripes[views == 3] - np.add(BLUE, ORANGE) / 2).max() <= 1


def test_cameras_are_drawn_where_they_stand():
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[:, 0, 3] = torch.tensor([1.0, -1.0])  # the first stands on the left
    cameras = Cameras(poses, torch.full((2, 2), 100.0), torch.full((2, 2), 50.0), 100, 100)
    behind, _, before, *_ = NotebookPicture.of_cameras(cameras, 4).frames
    assert place(before, BLUE)[0] < 200 < place(before, ORANGE)[0]
    assert place(behind, BLUE)[0] > 200 > place(behind, ORANGE)[0]
    many = NotebookPicture.of_cameras(cameras[[0, 1] * 100])
    assert "200 cameras" in many.facts and "100 of them are drawn" in many.facts


def test_the_cone_of_a_rig_is_the_panels():
    scene, panel = balls([[0, 0, 3]], [RED]), Panel(120, 60, 5, 6.0, 0.1, cone_deg=25.0)
    rig = Rig.frame(scene, panel)
    assert "the panel says its own" in rig._repr_html_()
    assert "cone 25 degrees of panel panel; 5 cameras drawn" in rig.show(panel).facts
    right, left = place(rig.show(panel).frames[12], BLUE)[0], place(rig.show(panel).frames[12], ORANGE)[0]
    assert left < right  # view 0 goes to the right-most eye
    with pytest.raises(InputError, match="give panel="):
        scene.show(rig=rig)
    assert len(scene.show(panel, rig).frames) == NotebookPicture.FRAMES


def test_images_stand_beside_each_other_and_change_by_show():
    scene, panel = balls([[0, 0, 3]], [RED]), Panel(120, 60, 5, 6.0, 0.1)
    images = render(scene, Rig.frame(scene, panel).cameras(panel), depth=True)
    expected = (255 * images.image.clamp(0, 1)).round().byte().numpy()
    assert np.array_equal(images.show().frames, expected)
    row = NotebookPicture.of_images(images)
    assert np.array_equal(row.frames[0][:60, 120:240], expected[1]) and row.facts == "5 images, 120 x 60 px, and depth"


def test_a_fit_shows_its_panel_and_its_scores():
    scene, panel = balls([[0, 0, 3]], [RED]), Panel(120, 60, 5, 6.0, 0.1, name="small")
    rig, scores = Rig.frame(scene, panel), Scores(["a", "b"], [30.0, 32.0], [0.9, 0.8])
    display = Display(panel, None, rig.relative_to((-9.0, 0.0, 0.0)), ())  # in the capture's coordinates
    scene = replace(scene, origin=(9.0, 0.0, 0.0))
    fitted = FitResult(scene, FitSettings(), 70, scores, [], True, display)
    facts = "fit of 70 steps, stopped, 31.00 dB and SSIM 0.850 on 2 held-out photographs; Gaussians(1, "
    assert facts in fitted._repr_html_() and "on panel small, whose 5 views span 40 degrees" in fitted._repr_html_()
    frames = fitted.show().frames
    expected = NotebookPicture.of_views(scene, panel, rig, background=(0.0, 0.0, 0.0)).frames  # that of the settings
    assert len(frames) == NotebookPicture.FRAMES and np.abs(np.subtract(frames, expected, dtype=int)).max() <= 1
    around = FitResult(scene, FitSettings(), 70, None, [], False)
    assert around.show().facts.startswith("fit of 70 steps; Gaussians(1, ") and len(around.show().frames) == 25


def test_no_cell_has_more_than_300_kb_and_strings_are_escaped():
    noise = np.random.default_rng(0).integers(0, 256, (24, 300, 400, 3), np.uint8)
    text = NotebookPicture(list(noise), '<script>"&')._repr_html_()
    assert len(text) <= 300_000 and "<script>" not in text and "&lt;script&gt;&quot;&amp;" in text


def test_what_cannot_be_drawn_says_why():
    scene = balls([[0, 0, 3]], [RED])
    scene.scales[0, 0] = -1
    text = scene._repr_html_()
    assert "<img" not in text and "expected a standard deviation &gt; 0, got -1" in text
    assert "nothing to see" in scene[:0]._repr_html_()
    with pytest.raises(InputError, match="no picture to write: Gaussians"):
        scene[:0].show().save("orbit.html")
