"""Depth, size and place of a scene on a panel: against projections of points, and pictures of the views."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from look_cases import PANEL, RIG, sheet

from lightfield_gs import Look, encode, render
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig


def seen_at(rig: Rig, panel: Panel, point, view: int) -> np.ndarray:
    """Pixel where the camera of a view, as it is handed to the rasterizer, sees a point; float64."""
    camera = rig.cameras(panel, [view])
    x, y, z = (camera.world_to_camera[0].numpy() @ [*point, 1.0])[:3]
    return camera.focal_px[0].numpy() * [x / z, y / z] + camera.principal_point_px[0].numpy()


def disparity(rig: Rig, depth: float) -> float:
    """Between the outermost views, of a point at this depth, in pixels."""
    right, left = (seen_at(rig, PANEL, (0.1, 0.2, depth), view) for view in (0, PANEL.views - 1))
    return float(right[0] - left[0])


def test_nothing_changes_without_a_change():
    assert Look().applied(RIG, PANEL).to_dict() == RIG.to_dict()
    own = replace(RIG, cone_deg=25.0)
    assert Look().applied(own, PANEL).to_dict() == own.to_dict()


def test_the_focus_has_no_parallax_and_the_centre_view_stays():
    rig = Look(focus=3.5).applied(RIG, PANEL)
    assert abs(disparity(rig, 3.5)) < 1e-12
    assert disparity(rig, 5.0) > 0 > disparity(rig, 2.5)
    middle, before = (of.cameras_at(PANEL, [4.0]) for of in (rig, RIG))
    assert torch.equal(middle.world_to_camera, before.world_to_camera)
    assert torch.equal(middle.principal_point_px, before.principal_point_px)


def test_disparities_follow_the_formula():
    rig = Look(focus=2.5, depth_amount=1.5, cone_deg=30, zoom=1.25).applied(RIG, PANEL)
    tangent = 1.5 * math.tan(math.radians(15))
    assert disparity(rig, 4.0) == pytest.approx(2 * (1 - 1 / 8) * 1.25 * 96 * tangent * (1 - 2.5 / 4), rel=1e-12)


@pytest.mark.parametrize("cone_deg", [None, 25.0])
def test_the_amount_multiplies_disparities(cone_deg):
    rig = replace(RIG, cone_deg=cone_deg)
    for amount in (0.5, 2.0):
        for depth in (1.2, 9.0):
            changed = Look(depth_amount=amount).applied(rig, PANEL)
            assert disparity(changed, depth) == pytest.approx(amount * disparity(rig, depth), rel=1e-12)


@pytest.mark.parametrize("method", ["direct", "sorted", "classic"])
def test_no_depth_shows_the_same_picture_in_every_view(method):
    scene = sheet((1.5, 0.6, 0.2, 0.6), (4.0, 0.9, 0, 1))
    rig = Look(depth_amount=0).applied(RIG, PANEL)
    views = render(scene, rig.cameras(PANEL)).image
    assert all(torch.equal(view, views[0]) for view in views)
    # and so the panel shows that picture, whatever view a sub-pixel belongs to
    image = encode(scene, PANEL, rig, method, output="float32")
    assert float((image - views[0]).abs().max()) < 2e-5


def test_zoom_and_pan_move_the_picture_about_the_middle_of_the_panel():
    rig = Look(zoom=1.5, pan=(-0.25, 0.1)).applied(RIG, PANEL)
    middle = np.array([96 / 2, 60 / 2])
    for view in (0, 5):
        before, after = (seen_at(of, PANEL, (0.3, -0.2, 3.0), view) for of in (RIG, rig))
        assert after == pytest.approx(middle + 1.5 * (before - middle) + [-0.25 * 96, 0.1 * 60], abs=1e-12)
    assert rig.zero_depth == RIG.zero_depth and rig.cone_deg is None


def test_the_focus_is_the_nearest_surface_at_a_point():
    scene = sheet((1.5, 0.9, 0.1, 0.4), (1.0, 0.05, 0, 0.8), (4.0, 0.9, 0, 0.8))  # haze before all of it
    assert Look(focus=(0.25, 0.5)).applied(RIG, PANEL, scene).zero_depth == pytest.approx(1.5)
    assert Look(focus=(0.6, 0.5)).applied(RIG, PANEL, scene).zero_depth == pytest.approx(4.0)
    # The point is one of the picture as it comes out: zoomed about the middle, and moved
    moved = Look(focus=(0.6 - 0.25, 0.5), pan=(-0.25, 0)).applied(RIG, PANEL, scene)
    assert moved.zero_depth == pytest.approx(4.0)
    zoomed = Look(focus=(0.1, 0.5), zoom=2).applied(RIG, PANEL, scene)  # 0.3 of the picture before
    assert zoomed.zero_depth == pytest.approx(1.5)


def test_a_focus_on_nothing_is_refused():
    scene = sheet((1.5, 0.9, 0.1, 0.4), (4.0, 0.2, 0, 0.6))
    with pytest.raises(
        InputError, match=r"^focus: nothing opaque is at 0\.9,0\.5 of the picture .*; give another point"
    ):
        Look(focus=(0.9, 0.5)).applied(RIG, PANEL, scene)
    with pytest.raises(InputError, match="needs the Gaussians"):
        Look(focus=(0.9, 0.5)).applied(RIG, PANEL)


@pytest.mark.parametrize(
    "change, words",
    [
        (dict(focus=0), "look: focus must be"),
        (dict(focus=math.nan), "look: focus must be"),
        (dict(focus=(0.5, 1.5)), "look: focus, x and y, must be 0..1"),
        (dict(focus=(1, 1, 1)), "look: focus must be a depth, or x and y"),
        (dict(depth_amount=2.5), "look: depth_amount must be 0..2"),
        (dict(cone_deg=180), "look: cone_deg must be 0..179"),
        (dict(zoom=0), "look: zoom must be"),
        (dict(pan=0.5), "look: pan must be two numbers"),
        (dict(pan=(0, math.inf)), "look: pan must be"),
    ],
)
def test_values_out_of_range_are_refused(change, words):
    with pytest.raises(InputError, match=f"^{words}"):
        Look(**change)
