"""Pictures of scenes on panels of another shape: filled, with the subject whole, unless an object stands alone."""

import pytest
from look_cases import PANEL, RIG, sheet
from panel_cases import plain_panel

from lightfield_gs.photo.fill_panel import fill_panel

SIZE = (PANEL.width_px, PANEL.height_px)  # 96 x 60
TALL, WIDE = plain_panel(60, 96), plain_panel(192, 60)
WALL = (4.0, 0.99, -0.2, 1.2)  # depth, opacity, left and right edge in widths of the picture


def ends(rig, left, right, depth=2.0):
    """Where the edges of a sheet come to lie on a panel, px."""
    return [rig.focal_px[0] * (edge * 96 - 45) / 96 + rig.principal_point_px[0] for edge in (left, right)]


def test_a_narrow_subject_lets_the_picture_fill_a_tall_panel():
    scene = sheet(WALL, (2.0, 0.99, 0.6, 0.8))
    rig = fill_panel(RIG, SIZE, TALL, scene)
    assert rig.focal_px[1] == pytest.approx(RIG.focal_px[1] * 96 / 60)  # as high as the panel
    left, right = ends(rig, 0.6, 0.8)
    assert 0 <= left < right <= 60 and abs((left + right) / 2 - 30) < 3
    assert rig.zero_depth == RIG.zero_depth


def test_a_wide_subject_stays_whole():
    scene = sheet(WALL, (2.0, 0.99, 0.1, 0.6))
    fitted, rig = RIG.fitted(SIZE, TALL), fill_panel(RIG, SIZE, TALL, scene)
    assert 1.5 < rig.focal_px[0] / fitted.focal_px[0] < 1 / 0.5
    left, right = ends(rig, 0.1, 0.6)
    assert 0 <= left < right <= 60


def test_a_third_of_a_picture_without_a_subject_is_cropped_at_most():
    fitted, rig = RIG.fitted(SIZE, WIDE), fill_panel(RIG, SIZE, WIDE, sheet(WALL))
    assert rig.focal_px[0] / fitted.focal_px[0] == pytest.approx(1 / 0.66)


@pytest.mark.parametrize("panel", [TALL, plain_panel(192, 120)])
def test_an_object_alone_and_a_panel_of_the_same_shape_show_all(panel):
    layers = [(2.0, 0.99, 0.3, 0.6)] if panel is TALL else [WALL]
    assert fill_panel(RIG, SIZE, panel, sheet(*layers)).to_dict() == RIG.fitted(SIZE, panel).to_dict()
