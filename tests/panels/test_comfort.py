"""The report on depth: its numbers from points projected by the cameras of views, and from two eyes' lines of sight."""

import json
import math
from dataclasses import replace

import look_cases
import numpy as np
import pytest
from look_cases import RIG, sheet

from lightfield_gs import Look, depth_report
from lightfield_gs.base.errors import InputError
from lightfield_gs.panels.comfort import (
    EYE_SEPARATION_MM,
    comfortable_amount,
    locate_depth,
    neighbour_step_px,
    sharp_depths,
)
from lightfield_gs.panels.panel import Panel
from lightfield_gs.panels.rig import Rig
from lightfield_gs.panels.simulate import simulate
from lightfield_gs.panels.visibility import background_fraction
from lightfield_gs.scene.gaussians import Gaussians

PANEL = replace(look_cases.PANEL, viewing_distance_mm=700, pixel_pitch_mm=4.0)
NEAR, FAR = 1.5, 4.0
SCENE = sheet((NEAR, 0.9, 0.3, 0.6), (FAR, 0.9, -1, 2))


def column(rig: Rig, panel: Panel, depth: float, x: float) -> float:
    """Pixel column where the camera at view coordinate x sees a point at this depth; float64."""
    camera = rig.cameras_at(panel, [x])
    at = camera.world_to_camera[0].numpy() @ [0.1, 0.2, depth, 1]
    return float(camera.focal_px[0, 0] * at[0] / at[2] + camera.principal_point_px[0, 0])


def test_neighbouring_views_are_as_far_apart_as_their_cameras_show():
    steps = [abs(column(RIG, PANEL, depth, 0.5) - column(RIG, PANEL, depth, 1.5)) for depth in (NEAR, FAR)]
    assert neighbour_step_px(SCENE, PANEL, RIG) == pytest.approx(max(steps), rel=1e-3)


def eyes_see(rig: Rig, panel: Panel, depth: float) -> tuple[float, float]:
    """Columns in mm where the left and the right eye see a point, by where each is in the viewing zone."""
    zone = 2 * panel.viewing_distance_mm * math.tan(math.radians(panel.cone_deg / 2))
    places = (panel.views * (0.5 - side * EYE_SEPARATION_MM / 2 / zone) for side in (-1, 1))
    # On a panel wired the other way, it is the left eye that sees the small view numbers
    if panel.invert_views:
        places = (panel.views - place for place in places)
    left, right = (panel.pixel_pitch_mm * column(rig, panel, depth, place) for place in places)
    return left, right


@pytest.mark.parametrize("invert", [False, True])
@pytest.mark.parametrize("depth", [0.9, NEAR, 2.0, FAR, 30.0])
def test_a_place_is_where_two_lines_of_sight_meet(depth, invert):
    panel = replace(PANEL, invert_views=invert)
    rig = Look(cone_deg=25, zoom=1.3).applied(RIG, panel)
    place = locate_depth(depth, panel, rig)
    right_most = panel.views - 0.5 if invert else 0.5
    edge = column(rig, panel, depth, right_most) - column(rig, panel, depth, panel.views / 2)
    assert place.edge_px == pytest.approx(edge, abs=1e-11) and place.edge_mm == pytest.approx(4 * edge, abs=1e-11)
    left, right = eyes_see(rig, panel, depth)
    assert place.eyes_mm == pytest.approx(right - left, abs=1e-11)
    assert place.eyes_px == pytest.approx((right - left) / 4, abs=1e-11)
    # Eyes at (-e/2, L) and (e/2, L), places on the panel at z = 0, around its middle: where do the lines meet?
    e, distance = EYE_SEPARATION_MM, 700.0
    eyes, hits = np.array([[-e / 2, distance], [e / 2, distance]]), np.array([[left, 0.0], [right, 0.0]])
    ways = hits - eyes
    if right - left < e:
        t = np.linalg.solve(np.stack([ways[0], -ways[1]], 1), eyes[1] - eyes[0])
        assert place.behind_mm == pytest.approx(-(eyes[0] + t[0] * ways[0])[1], rel=1e-9, abs=1e-9)
    else:
        assert place.behind_mm is None
    centred = [[-(right - left) / 2 + e / 2, distance], [(right - left) / 2 - e / 2, distance]]
    angle = math.atan(centred[0][0] / distance) - math.atan(centred[1][0] / distance)
    assert place.angle_deg == pytest.approx(math.degrees(2 * math.atan(e / 2 / distance) - angle), abs=1e-9)


def test_the_report_finds_near_and_far():
    report = depth_report(SCENE, PANEL, RIG)
    assert (report.near.depth, report.far.depth) == pytest.approx((NEAR, FAR), rel=1e-6)
    assert (report.near, report.far) == tuple(locate_depth(of.depth, PANEL, RIG) for of in (report.near, report.far))
    assert report.near.behind_mm < 0 < report.far.behind_mm and report.zero_depth == 2.0
    assert json.loads(json.dumps(report.to_dict(), allow_nan=False))["near"]["depth"] == report.near.depth
    text = "\n".join(report.lines())
    assert "Lambooij" in text and f"{-report.near.behind_mm:.3g} mm before the panel" in text


def test_the_comfortable_amount_is_just_comfortable():
    report = depth_report(SCENE, PANEL, RIG)
    assert report.comfortable is False and any("depth_amount=" in words for words in report.warnings())
    for share, comfortable in ((0.999, True), (1.001, False)):
        changed = depth_report(SCENE, PANEL, Look(depth_amount=share * report.amount).applied(RIG, PANEL))
        assert changed.comfortable is comfortable
    assert max(-changed.near.angle_deg, changed.far.angle_deg) == pytest.approx(1, abs=2e-3)


def test_sharp_is_what_moves_by_a_lens_a_step_at_most():
    """Independently: by columns of two views that are a step apart, and by beams of a lens before the panel."""
    report = depth_report(SCENE, PANEL, RIG)
    views = 8  # fewer than sub-pixels behind a lens: a step is a view
    for depth in report.sharp_depths:
        moved = column(RIG, PANEL, depth, 4) - column(RIG, PANEL, depth, 5)
        assert abs(moved) == pytest.approx(9.8 / 3, rel=1e-9)
        assert locate_depth(depth, PANEL, RIG).blur_lenses == pytest.approx(1)
        assert locate_depth(2 / (1 + 2 * (2 / depth - 1)), PANEL, RIG).blur_lenses == pytest.approx(2)
    many = replace(PANEL, views=900)  # then it is a sub-pixel
    first, last = depth_report(SCENE, many, RIG).sharp_depths
    assert 2 / first - 1 == pytest.approx((2 / report.sharp_depths[0] - 1) * 9.8 / views)
    assert last > report.sharp_depths[1] > 2
    # A plane at the limit is displaced, between the eyes, as what stands that far before and behind the panel is
    for depth, reach in zip(report.sharp_depths, (-report.sharp_mm[0], report.sharp_mm[1])):
        assert locate_depth(depth, PANEL, RIG).behind_mm == pytest.approx(reach)


def test_an_eye_before_the_lenses_sees_as_much_blur_as_is_said():
    """Return how much wider an edge at some depth looks than in the panel's plane, in lenses.

    The edge is drawn by hand and seen through the lenses. Width is full width at half maximum, by the second moment.
    """
    panel = replace(Panel.load("65in-8k-96v"), width_px=600, height_px=120)
    rig = Rig(np.eye(4), (900.0, 900.0), (300.0, 60.0), zero_depth=2.0)
    views, columns = panel.view_map() + 0.5, np.arange(600)[:, None] + (np.arange(3) + 0.5) / 3

    def width(depth: float) -> float:
        moves = rig.offset(views, panel) * 900 * (1 / 2 - 1 / depth)
        image = (columns > 300 + moves).astype(np.float32)
        edge = simulate(image, panel, (5.0, 0.0, 2000.0))[8:-8, :, 1].mean(0)
        slopes, places = np.abs(np.diff(edge)), np.arange(len(edge) - 1)
        middle = (slopes * places).sum() / slopes.sum()
        return math.sqrt((slopes * (places - middle) ** 2).sum() / slopes.sum())

    sharp = width(2.0)
    assert width(sharp_depths(panel, rig)[1]) < 1.1 * sharp
    for depth in (1.6, 2.6):
        wider = math.sqrt(8 * math.log(2) * (width(depth) ** 2 - sharp**2))
        assert wider == pytest.approx(locate_depth(depth, panel, rig).blur_lenses, rel=0.1)


def test_a_flat_picture_is_sharp_and_comfortable():
    report = depth_report(SCENE, PANEL, Look(depth_amount=0).applied(RIG, PANEL))
    assert report.near.behind_mm == report.far.behind_mm == 0 and report.comfortable and report.amount is None
    assert report.sharp_depths == (0, None) and report.near.blur_lenses == 1 and max(report.unseen) == 0
    assert report.warnings() == []


def test_a_panel_without_measures_has_pixels_only():
    report = depth_report(SCENE, replace(PANEL, viewing_distance_mm=None), RIG)
    assert report.near.edge_px == pytest.approx(-96 * math.tan(math.radians(20)) * (1 - 1 / 8) * (2 / NEAR - 1))
    assert report.near.behind_mm is report.comfortable is report.amount is None and report.sharp_mm == (None, None)
    assert any("viewing_distance_mm=" in line for line in report.lines())


def test_what_nobody_has_seen_is_measured():
    """A photo in two layers: behind the front layer, and beyond the right edge of the picture, there is nothing."""
    whole = depth_report(SCENE, PANEL, RIG)
    assert max(whole.unseen) < 0.01
    photo = sheet((NEAR, 0.9, 0.3, 0.6), (FAR, 0.9, 0, 0.3), (FAR, 0.9, 0.6, 1))
    report = depth_report(photo, PANEL, RIG)
    # The front layer uncovers a strip on one side of it, and the right end of the picture another
    pixels = 7 / 8 * 2 * math.tan(math.radians(20)) * 96
    hole, edge = pixels * (1 / NEAR - 1 / FAR), pixels * (1 / 2 - 1 / FAR)
    assert report.unseen == pytest.approx([(hole + edge) / 96] * 2, rel=0.15)
    assert any("past what the scene knows" in words for words in report.warnings())
    # The photo fills the picture, so that it is certain; around a part of it there may well be air
    assert background_fraction(photo, PANEL, RIG) == pytest.approx(max(report.unseen), abs=0.02)
    assert background_fraction(SCENE, PANEL, RIG) < 0.01
    assert background_fraction(sheet((NEAR, 0.9, 0.3, 0.6)), PANEL, RIG) is None


def test_which_side_is_left():
    """Only the left part of what is behind the front layer is there: the right eye looks into the hole."""
    half = sheet((NEAR, 0.9, 0.2, 0.8), (FAR, 0.9, -1, 0.6), (FAR, 0.9, 0.8, 2))
    for panel in (PANEL, replace(PANEL, invert_views=True)):
        left, right = depth_report(half, panel, RIG).unseen
        assert right > 0.1 and left < 0.02


def test_a_rig_that_shows_nothing_is_refused():
    away = RIG.world_to_camera.copy()
    away[2, 3] = -100
    with pytest.raises(InputError, match="^the centre camera sees nothing of the scene"):
        depth_report(SCENE, PANEL, replace(RIG, world_to_camera=away))
    nothing, batch = (Gaussians(*map(of, SCENE.fields().values())) for of in (lambda t: t[:0], lambda t: t[None]))
    with pytest.raises(InputError, match="^the centre camera sees nothing of the scene"):
        depth_report(nothing, PANEL, RIG)
    with pytest.raises(InputError, match="^focus: nothing opaque is at"):
        Look(focus=(0.5, 0.5)).applied(RIG, PANEL, nothing)
    for refused in (lambda: depth_report(batch, PANEL, RIG), lambda: Look(focus=(0, 0)).applied(RIG, PANEL, batch)):
        with pytest.raises(InputError, match="^gaussians: expected one set, got a batch of 1"):
            refused()


def test_the_comfortable_amount_is_the_most_that_does_not_strain_the_eyes():
    near_panel = replace(PANEL, viewing_distance_mm=400)
    assert depth_report(SCENE, near_panel, RIG).comfortable is False
    amount = comfortable_amount(SCENE, near_panel, RIG)
    assert amount is not None and 0 < amount < 1
    assert depth_report(SCENE, near_panel, Look(depth_amount=amount).applied(RIG, near_panel)).comfortable is True
    more = Look(depth_amount=1.15 * amount).applied(RIG, near_panel)
    assert depth_report(SCENE, near_panel, more).comfortable is False
    assert comfortable_amount(SCENE, near_panel, Look(depth_amount=amount).applied(RIG, near_panel)) is None
    assert comfortable_amount(SCENE, replace(PANEL, viewing_distance_mm=None), RIG) is None
