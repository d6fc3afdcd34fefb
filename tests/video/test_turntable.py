"""Rigs that go round the subject, against closed forms and against the scene turned the other way."""

import math

import numpy as np
import pytest
import torch
from command_line import PANEL, scene

from lightfield_gs import Gaussians, InputError, Rig, encode
from lightfield_gs.scene.axes import upright_rotation
from lightfield_gs.video.camera_path import orbit, pivot_point, turntable


def place(rig: Rig) -> np.ndarray:
    return -rig.world_to_camera[:3, :3].T @ rig.world_to_camera[:3, 3]


def tilted_rig() -> Rig:
    rig = Rig.frame(scene(), PANEL)
    angle = 0.3
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return Rig(tilt @ rig.world_to_camera, rig.focal_px, (40.0, 33.0), rig.zero_depth)


def test_a_quarter_turn_puts_the_camera_to_the_right():
    rig = Rig(np.eye(4), (100.0, 100.0), (48.0, 30.0), 2.0)
    np.testing.assert_allclose(place(orbit(rig, PANEL, 90)), [2, 0, 2], atol=1e-12)


def test_frame_0_and_full_turns_are_the_rig_itself():
    rig = tilted_rig()
    for degrees in (0, 360, -720):
        assert orbit(rig, PANEL, degrees, np.array([0.0, 0, 1])).to_dict() == rig.to_dict()
    assert turntable(rig, PANEL, 7)[0].to_dict() == rig.to_dict()
    assert turntable(rig, PANEL, 7, 30)[0].to_dict() == rig.to_dict()


def test_the_middle_of_the_panel_stays_and_the_height_above_it():
    rig, up = tilted_rig(), np.array([0.0, -1, 0])

    def pivot(rig: Rig) -> np.ndarray:
        return rig.world_to_camera[:3, :3].T @ (pivot_point(rig, PANEL) - rig.world_to_camera[:3, 3])

    for turn in turntable(rig, PANEL, 8, 360, up):
        np.testing.assert_allclose(pivot(turn), pivot(rig), atol=1e-12)
        assert (place(turn) - place(rig)) @ up == pytest.approx(0, abs=1e-12)


def test_going_round_is_the_scene_turned_the_other_way():
    """One and the same picture, of a scene with view-dependent colours, but for rounding."""
    gaussians = scene()
    rig = Rig.frame(gaussians, PANEL)
    point = torch.from_numpy(
        rig.world_to_camera[:3, :3].T @ (pivot_point(rig, PANEL) - rig.world_to_camera[:3, 3])
    ).float()
    angle = math.radians(40)
    back = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    fields = gaussians.fields()
    there = Gaussians(fields.pop("means") - point, *fields.values()).rotated(back)
    fields = there.fields()
    scene_turned = Gaussians(fields.pop("means") + point, *fields.values())
    one = encode(gaussians, PANEL, orbit(rig, PANEL, 40), output="float64")
    other = encode(scene_turned, PANEL, rig, output="float64")
    assert (one - other).abs().max() < 1e-4
    assert (one - encode(gaussians, PANEL, rig, output="float64")).abs().max() > 0.1


def test_half_a_turn_of_a_symmetric_scene_shows_the_same():
    half = scene(30)
    fields = half.fields()
    fields["sh"] = fields["sh"][:, :1]
    half = Gaussians(**fields)
    across = half.rotated(np.diag([-1.0, 1, -1]))
    both = Gaussians(*(torch.cat(pair) for pair in zip(half.fields().values(), across.fields().values())))
    rig = Rig(np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]), (150.0, 150.0), (48.0, 30.0), 3.0)
    before, after = (encode(both, PANEL, orbit(rig, PANEL, a), output="float64") for a in (0, 180))
    assert (before - after).abs().max() < 1e-6
    assert (before - encode(both, PANEL, orbit(rig, PANEL, 90), output="float64")).abs().max() > 0.1


def test_a_swing_goes_to_both_sides_and_back():
    rig = Rig(np.eye(4), (100.0, 100.0), (48.0, 30.0), 2.0)
    x = [place(turn)[0] for turn in turntable(rig, PANEL, 4, 60)]
    np.testing.assert_allclose(x, [0, 1, 0, -1], atol=1e-12)  # 2 sin(30 degrees)


@pytest.mark.parametrize("up", [(0, 0, 0), (0, math.nan, 1), (1, 0)])
def test_an_axis_without_a_direction_is_refused(up):
    with pytest.raises(InputError, match="^up: expected three finite numbers"):
        orbit(tilted_rig(), PANEL, 10, np.array(up))


def test_the_axis_of_an_upright_camera_is_what_is_up():
    for up in ("z", "y", "-y"):
        rig = Rig.frame(scene(), PANEL, up=up)
        one, other = orbit(rig, PANEL, 25), orbit(rig, PANEL, 25, -upright_rotation(up)[1])
        np.testing.assert_allclose(one.world_to_camera, other.world_to_camera, atol=1e-12)
